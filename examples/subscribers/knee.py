"""Print the knee flexion ten times per second: python knee.py [HOST [PORT [BASE]]].

The script needs `pip install aiomqtt`. BASE is the value of `base` under [mqtt] in rig.toml; the
default is jointfit/bench-1.
"""

import asyncio
import json
import sys

import aiomqtt

DEFAULTS = ("127.0.0.1", "1883", "jointfit/bench-1")
HOST, PORT, BASE = (*sys.argv[1:4], *DEFAULTS[len(sys.argv[1:4]) :])


async def main() -> None:
    """Subscribe; subscribe again after each loss of the broker."""
    while True:
        try:
            async with aiomqtt.Client(HOST, int(PORT)) as client:
                await client.subscribe(f"{BASE}/pose/ui")
                async for message in client.messages:
                    knee = json.loads(bytes(message.payload))["joints"]["knee"]
                    if knee["flexion_deg"] is None:
                        print("knee flexion unknown", flush=True)
                    else:
                        print(
                            f"knee flexion {knee['flexion_deg']}° ± {knee['sd_deg']}°", flush=True
                        )
        except aiomqtt.MqttError as error:
            print(f"broker {HOST}:{PORT}: {error}; retrying", file=sys.stderr)
            await asyncio.sleep(1)


asyncio.run(main())
