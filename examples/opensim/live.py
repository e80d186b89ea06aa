"""An OpenSim model that moves along: outputs: {opensim: {model: FILE}}, then  python live.py FILE"""

import json
import socket
import sys

import opensim

model = opensim.Model(sys.argv[1])
state = model.initSystem()
receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
receiver.bind(("127.0.0.1", 39800))
while True:
    pose = json.loads(receiver.recv(65536))
    for name, value in pose["coordinates"].items():
        model.updCoordinateSet().get(name).setValue(state, value, False)
    model.realizePosition(state)
    print(pose["seq"], model.calcMassCenterPosition(state).to_numpy(), flush=True)
