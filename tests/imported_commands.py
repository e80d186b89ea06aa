"""All that commands import, for the process that ``tests.fixtures.commands`` forks them from.

Kernels are read from the disk here, once, too.
"""

import importlib

from gateway.body.rig import load_rig
from gateway.cli.lazy_commands import load
from gateway.cli.main import _Commands
from gateway.reconstruction import create_reconstructor

for _name in ("run", "record", "emulate", "watch", "modules", "doctor", "demo", "health"):
    load(_name, _Commands.lazy[_name])
for _name in (  # what they import when they are called
    *("devices.commands.card", "devices.endpoints", "gateway.doctor.examination", "gateway.emulation.rig"),
    *(
        "gateway.modules.motion",
        "gateway.modules.remote",
        "gateway.modules.session",
        "gateway.service.service",
    ),
    *("gateway.outputs.subscriber", "gateway.service.readiness", "gateway.viewer.pose_table"),
):
    importlib.import_module(_name)
create_reconstructor("independent", load_rig("single"), 0.01)
