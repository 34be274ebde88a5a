"""What cantools makes of a DBC file: its messages, then seeded frames with the values in them.

One line a message: message NAME ID EXTENDED LENGTH CYCLE_MS
One line a frame:   frame NAME DATA AGAIN SIGNAL=VALUE ...
DATA and AGAIN in hexadecimal, AGAIN being the values encoded again; values in the units of the file, to the bit.
"""

import math
import random
import sys

import cantools

database = cantools.database.load_file(sys.argv[1])
chance = random.Random(402)

for message in database.messages:
    print("message", message.name, message.frame_id, int(message.is_extended_frame), message.length, message.cycle_time or 0)
    for number in range(60):
        data = bytearray(chance.randbytes(message.length))
        if message.is_multiplexed():
            # Values of the switches that mean something, most of the time.
            data[0] = chance.choice([0x00, 0x10, 0x20, 0x01, 0x09, 0x05, data[0]])
        try:
            values = message.decode(data, decode_choices=False)
        except cantools.database.errors.DecodeError:
            print("frame", message.name, data.hex(), "-")
            continue
        if not all(math.isfinite(value) for value in values.values()):
            continue
        again = message.encode(values, strict=False)
        pairs = [f"{name}={float(value).hex()}" for name, value in values.items()]
        print("frame", message.name, data.hex(), again.hex(), *pairs)
