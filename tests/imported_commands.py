"""All that commands import, for the process that ``tests.fixtures.commands`` forks them from.

Kernels are read from the disk here, once, too.
"""

from gateway.body.rig import load_rig
from gateway.cli.lazy_commands import load
from gateway.cli.main import _Commands
from gateway.reconstruction import create_reconstructor

for _name in ("run", "record", "emulate", "watch", "modules", "doctor", "demo", "health"):
    load(_name, _Commands.lazy[_name])
create_reconstructor("independent", load_rig("single"), 0.01)
