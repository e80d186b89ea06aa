"""``python -m gateway.cli.companion PARENT …``: a command that ends with the process that started it."""

from __future__ import annotations

import sys

from gateway.cli.main import main
from gateway.support.parent import end_with_parent

if __name__ == "__main__":
    end_with_parent(int(sys.argv.pop(1)))
    main()
