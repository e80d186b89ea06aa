"""Print heading and status of every segment, from any gateway at a broker. Needs: pip install aiomqtt

python subscribe.py --host 127.0.0.1 --port 1883 --count 10
"""

import argparse
import asyncio
import contextlib
import json
import math

import aiomqtt


def heading_deg(q):
    """Turn about the vertical, counter-clockwise seen from above, of an orientation [w, x, y, z]."""
    w, x, y, z = q
    return math.degrees(math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)))


async def main(host, port, count):
    async with aiomqtt.Client(host, port) as client:
        await client.subscribe("mocap/+/bridge/state", qos=1)
        await client.subscribe("mocap/+/pose")
        async for message in client.messages:
            gateway, topic = str(message.topic).split("/", 2)[1:]
            data = json.loads(message.payload)
            if topic == "bridge/state":
                print(f"{gateway} is {data['state']}", flush=True)
                continue
            known = {name: q for name, q in data["segments"].items() if q is not None}
            headings = "  ".join(f"{name} {heading_deg(q):+.0f}°" for name, q in known.items())
            print(f"{gateway} {data['seq']}  {headings}", flush=True)
            count -= 1
            if count == 0:
                return


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Print headings of all segments.")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=1883)
    parser.add_argument("--count", type=int, default=-1, help="end after so many poses")
    options = parser.parse_args()
    try:
        with contextlib.suppress(KeyboardInterrupt):  # Ctrl-C is how it is ended
            asyncio.run(main(options.host, options.port, options.count))
    except aiomqtt.MqttError as error:
        raise SystemExit(
            f"no broker at {options.host}:{options.port} ({error}): start the gateway first"
        ) from None
