"""An independent CANopen drive for the master of `fric hil`.

Argument: a link to a pseudo-terminal, host:port of a TCP door, or the name of an interface. Node 5 with the object
dictionary, network management, SDO server and PDOs of the package canopen; the state machine of CiA 402 and a shaft of
1 kg·m², whose time goes on by 40 ms with each SYNC, are below. Prints `ready` once it is on the bus, and when a line, or
the end, comes in what it saw, one `name value` a line.
"""

import struct
import sys
import threading
import time

import canopen
from canopen.objectdictionary import ODArray, ODRecord, ODVariable, datatypes as kinds

from network import connect

NODE = 5
PERIOD = 0.04
INERTIA = 1.0
RATED = 2.0
COUNT = 2 * 3.141592653589793 / 65536
SPEED_UNIT = 0.01 * 3.141592653589793 / 30


def dictionary():
    objects = canopen.ObjectDictionary()

    def variable(name, index, sub, kind, value, access):
        made = ODVariable(name, index, sub)
        made.data_type, made.default, made.access_type = kind, value, access
        return made

    def group(group, name, index, *members):
        made = group(name, index)
        for sub, (kind, value) in enumerate(members):
            made.add_member(variable(f"{name} {sub}", index, sub, kind, value, "rw"))
        objects.add_object(made)

    byte, word, long = kinds.UNSIGNED8, kinds.UNSIGNED16, kinds.UNSIGNED32
    for name, index, kind, value, access in [
        ("device type", 0x1000, long, 0x00020192, "const"),
        ("error register", 0x1001, byte, 0, "ro"),
        ("device name", 0x1008, kinds.VISIBLE_STRING, "fric simulated", "const"),
        ("heartbeat", 0x1017, word, 0, "rw"),
        ("abort option", 0x6007, kinds.INTEGER16, 1, "rw"),
        ("error code", 0x603F, word, 0, "ro"),
        ("control word", 0x6040, word, 0, "rw"),
        ("status word", 0x6041, word, 0x40, "ro"),
        ("quick stop option", 0x605A, kinds.INTEGER16, 2, "rw"),
        ("mode", 0x6060, kinds.INTEGER8, 0, "rw"),
        ("mode shown", 0x6061, kinds.INTEGER8, 0, "ro"),
        ("position", 0x6064, kinds.INTEGER32, 0, "ro"),
        ("speed", 0x606C, kinds.INTEGER32, 0, "ro"),
        ("target torque", 0x6071, kinds.INTEGER16, 0, "rw"),
        ("greatest torque", 0x6072, word, 1000, "rw"),
        ("rated torque", 0x6076, long, int(RATED * 1000), "ro"),
        ("torque", 0x6077, kinds.INTEGER16, 0, "ro"),
        ("greatest speed", 0x6080, long, 3000, "rw"),
        ("modes", 0x6502, long, 1 << 9, "ro"),
    ]:
        objects.add_object(variable(name, index, 0, kind, value, access))
    group(ODArray, "watched heartbeats", 0x1016, (byte, 1), (long, 0))
    group(ODRecord, "identity", 0x1018, (byte, 4), (long, 0), (long, 402), (long, 1), (long, 0x66726963))
    group(ODRecord, "interpolation", 0x60C2, (byte, 2), (byte, 1), (kinds.INTEGER8, -3))
    for base, cob, kind in [(0x1400, 0x200, 255), (0x1800, 0x180, 1), (0x1801, 0x280, 1)]:
        group(ODRecord, "communication", base, (byte, 2), (long, cob + NODE | 0x80000000), (byte, kind))
        group(ODArray, "mapping", base + 0x200, (byte, 0), *[(long, 0)] * 8)
    return objects


class Drive:
    STATES = {0x40: "switch on disabled", 0x21: "ready", 0x23: "switched on", 0x27: "enabled", 0x07: "quick stop"}

    def __init__(self, network):
        self.network = network
        self.node = network.create_node(NODE, dictionary())
        self.node.add_write_callback(self.written)
        self.lock = threading.RLock()
        self.state, self.torque, self.speed, self.position = 0x40, 0, 0.0, 0.0
        self.heard, self.watched = None, (0, 0.0)
        self.seen, self.syncs, self.commands, self.timeouts, self.greatest = [], 0, 0, 0, 0
        network.subscribe(0, self.managed)
        network.subscribe(0x80, self.sync)
        self.boot()

    def boot(self):
        self.node.data_store.clear()
        self.go(0x40)
        self.node.nmt.state = "INITIALISING"
        self.node.nmt.state = "PRE-OPERATIONAL"

    def managed(self, id, data, stamp):
        if data[1] not in (0, NODE):
            return
        if data[0] in (0x81, 0x82):
            self.boot()
        elif data[0] == 1:
            # What the master has written becomes the maps of the package.
            self.node.tpdo.read()
            self.node.rpdo.read()
            self.node.rpdo[1].callbacks = [self.command]

    def written(self, index, subindex, od, data):
        if (index, subindex) == (0x1016, 1):
            number, = struct.unpack("<I", data)
            self.watched = (number >> 16 & 0x7F, (number & 0xFFFF) / 1000)
            self.network.subscribe(0x700 + self.watched[0], self.alive)
        if index == 0x6060:
            self.node.data_store[0x6061] = {0: data}

    def alive(self, id, data, stamp):
        self.heard = time.monotonic()

    def watch(self):
        """What only time shows: a master that is gone."""
        with self.lock:
            gone = self.heard is not None and time.monotonic() - self.heard > self.watched[1]
            if gone and self.state != 0x40:
                self.timeouts += 1
                self.go(0x40)
            if gone:
                self.heard = None

    def go(self, state):
        if not self.seen_state(state):
            self.seen.append(self.STATES[state])
        self.state = state
        if state != 0x27:
            self.torque = 0

    def seen_state(self, state):
        return self.seen[-1:] == [self.STATES[state]]

    def command(self, map):
        word, torque = map[0x6040].raw, map[0x6071].raw
        with self.lock:
            self.commands += 1
            if word & 0x02 == 0:
                self.go(0x40)
            elif word & 0x04 == 0:
                self.go(0x40 if self.state != 0x27 else 0x07)
            elif word & 0x0F == 0x06 and self.state in (0x40, 0x23, 0x27):
                self.go(0x21)
            elif word & 0x0F == 0x07 and self.state in (0x21, 0x27):
                self.go(0x23)
            elif word & 0x0F == 0x0F and self.state == 0x23:
                self.go(0x27)
            if self.state == 0x27:
                self.torque = torque
                self.greatest = max(self.greatest, abs(torque))

    def sync(self, id, data, stamp):
        if self.node.nmt.state != "OPERATIONAL":
            return
        with self.lock:
            self.syncs += 1
            acceleration = self.torque / 1000 * RATED / INERTIA
            self.position += PERIOD * (self.speed + PERIOD / 2 * acceleration)
            self.speed += PERIOD * acceleration
            values = {
                0x6041: self.state | 0x1200,
                0x6077: self.torque,
                0x606C: round(self.speed / SPEED_UNIT),
                0x6064: int(self.position // COUNT),
            }
            for map in self.node.tpdo.values():
                for variable in map:
                    variable.raw = values[variable.index]
                map.transmit()


def main(where):
    network = connect(where)
    drive = Drive(network)
    asked = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.readline(), asked.set()), daemon=True).start()
    print("ready", flush=True)
    while not asked.wait(0.01):
        drive.watch()
    print("states", ", ".join(drive.seen))
    print("syncs", drive.syncs)
    print("commands", drive.commands)
    print("timeouts", drive.timeouts)
    print("torque", drive.greatest)
    print("nmt", drive.node.nmt.state)
    network.disconnect()


main(sys.argv[1])
