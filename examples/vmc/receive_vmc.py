"""Print what a VMC receiver gets. Needs: pip install python-osc

python receive_vmc.py --port 39539 --count 5
"""

import argparse

from pythonosc.dispatcher import Dispatcher
from pythonosc.osc_server import BlockingOSCUDPServer


class Frames:
    """Gathers bones; a frame is whole when the next one begins."""

    def __init__(self, count):
        self.left = count
        self._bones = {}

    def begin(self, _address, *_values):
        if self._bones:
            x, y, z = self._bones["Hips"][:3]
            print(f"{len(self._bones)} bones, hips at {x:+.2f} {y:+.2f} {z:+.2f} m", flush=True)
            self.left -= 1
        self._bones = {}

    def bone(self, _address, name, *position_and_rotation):
        self._bones[name] = position_and_rotation  # px py pz, qx qy qz qw


def main():
    parser = argparse.ArgumentParser(description="Print what a VMC receiver gets.")
    parser.add_argument("--port", type=int, default=39539)
    parser.add_argument("--count", type=int, default=-1, help="end after so many frames")
    options = parser.parse_args()
    frames = Frames(options.count)
    dispatcher = Dispatcher()
    dispatcher.map("/VMC/Ext/OK", frames.begin)
    dispatcher.map("/VMC/Ext/Bone/Pos", frames.bone)
    with BlockingOSCUDPServer(("127.0.0.1", options.port), dispatcher) as server:
        print(f"listening on {server.server_address[1]}", flush=True)
        while frames.left:
            server.handle_request()


if __name__ == "__main__":
    main()
