#!/usr/bin/env bash
# The tests of SocketCAN: on this kernel where it has vcan0 and vcan1, and otherwise in a virtual machine.
# Skips with the reason where neither is to be had; any other failure is one.
set -uo pipefail
here=$(dirname "$0")
python=${PYTHON:-.venv/bin/python}
tests="$python -m pytest -p no:cacheprovider --color=no -m '' --confcutdir=$here $here/test_kernel_bus.py $here/test_firmware_on_bus.py"

if [ -e /sys/class/net/vcan0 ] && [ -e /sys/class/net/vcan1 ]; then
    eval "exec $tests"
fi
MACHINE_TIMEOUT=${MACHINE_TIMEOUT:-600} "$here/machine.sh" "$tests"
code=$?
if [ $code = 77 ]; then
    echo "SKIPPED: the tests of SocketCAN (see the line above)"
    exit 0
fi
exit $code
