"""What a robot's program gets: joint angles within its limits, as datagrams of outputs.retarget.udp."""

import json
import socket
import sys

receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
receiver.bind(("127.0.0.1", int(sys.argv[1]) if len(sys.argv) > 1 else 39700))
while True:
    pose = json.loads(receiver.recv(65536))
    print(pose["seq"], " ".join(f"{name} {angle:.3f}" for name, angle in pose["joints"].items()), flush=True)
