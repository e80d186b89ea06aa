"""Makes the simulated bodies of the accuracy tests importable from the tests here."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "accuracy"))
