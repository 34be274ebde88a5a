"""An independent CANopen node, a drive of CiA 402, for a master that is ours.

Arguments: a link to the pseudo-terminal of a `fric bus`, host:port of its TCP door, or socketcan:NAME; the serial number
it shall have; and how long it lives, s. Answers SDO, takes its PDO maps and its heartbeat consumer from what is written
into it, follows the control word, turns a shaft of 0.012 kg m^2 with the torque it is told, and prints each state it
enters, one a line.
"""

import struct
import sys
import threading
import time

import canopen
from canopen.objectdictionary import ODRecord, ODVariable, datatypes as kinds

NODE = 3
RATED = 4.0
INERTIA = 0.012
COUNT = 2 * 3.141592653589793 / 262144
RPM100 = 3.141592653589793 / 30 / 100


def dictionary(serial):
    objects = canopen.ObjectDictionary()

    def variable(index, sub, kind, value, parent=None):
        one = ODVariable(f"{index:04X}:{sub:02X}", index, sub)
        one.data_type, one.default, one.value = kind, value, value
        one.access_type = "rw"
        (parent or objects).add_member(one) if parent is not None else objects.add_object(one)

    def record(index, members):
        one = ODRecord(f"{index:04X}", index)
        objects.add_object(one)
        for sub, kind, value in members:
            variable(index, sub, kind, value, one)

    u8, u16, u32 = kinds.UNSIGNED8, kinds.UNSIGNED16, kinds.UNSIGNED32
    i8, i16, i32 = kinds.INTEGER8, kinds.INTEGER16, kinds.INTEGER32
    for index, kind, value in [
        (0x1000, u32, 0x00020192), (0x1001, u8, 0), (0x1005, u32, 0x80), (0x1006, u32, 0), (0x1017, u16, 0),
        (0x603F, u16, 0), (0x6007, i16, 0), (0x605A, i16, 2), (0x6040, u16, 0), (0x6041, u16, 0x240),
        (0x6060, i8, 0), (0x6061, i8, 0), (0x6064, i32, 0), (0x606C, i32, 0), (0x6071, i16, 0),
        (0x6072, u16, 1000), (0x6076, u32, int(RATED * 1000)), (0x6077, i16, 0), (0x6080, u32, 3000),
        (0x6087, u32, 1000000), (0x6502, u32, 1 << 9),
    ]:
        variable(index, 0, kind, value)
    variable(0x1008, 0, kinds.VISIBLE_STRING, "fric simulated")
    record(0x1016, [(0, u8, 1), (1, u32, 0)])
    # Vendor 0 is nobody's: what is simulated says so.
    record(0x1018, [(0, u8, 4), (1, u32, 0), (2, u32, 0), (3, u32, 0), (4, u32, serial)])
    record(0x1029, [(0, u8, 1), (1, u8, 0)])
    record(0x60C2, [(0, u8, 2), (1, u8, 1), (2, i8, -3)])
    for base, count in [(0x1400, 4), (0x1800, 4)]:
        for n in range(count):
            cob = (0x200 if base == 0x1400 else 0x180) + 0x100 * n + NODE
            record(base + n, [(0, u8, 5), (1, u32, cob | 0x80000000), (2, u8, 255), (3, u16, 0), (5, u16, 0)])
            record(base + 0x200 + n, [(0, u8, 0)] + [(sub, u32, 0) for sub in range(1, 9)])
    return objects


class Drive:
    def __init__(self, network, serial):
        self.network, self.lock = network, threading.RLock()
        self.node = network.create_node(NODE, dictionary(serial))
        self.state = None
        self.torque, self.speed, self.angle, self.last = 0.0, 0.0, 0.0, time.monotonic()
        self.heard = None
        self.fault = False
        self.enter(0x40)
        network.subscribe(0x80, self.sync)
        for n in range(4):
            network.subscribe(0x200 + 0x100 * n + NODE, self.told)
        for master in range(1, 128):
            if master != NODE:
                network.subscribe(0x700 + master, self.heartbeat)
        self.node.add_write_callback(lambda **_: self.written())

    def get(self, index, sub=0):
        return self.node.get_data(index, sub)

    def number(self, index, sub=0, signed=False):
        return int.from_bytes(self.get(index, sub), "little", signed=signed)

    def set(self, index, value, size, signed=False):
        self.node.data_store.setdefault(index, {})[0] = int(value).to_bytes(size, "little", signed=signed)

    def enter(self, state):
        if state != self.state:
            self.state = state
            print("state", hex(state), flush=True)
        # Bit 12: in mode 10 it follows the command.
        self.set(0x6041, state | 0x210 | (0x1000 if state == 0x27 else 0), 2)

    def written(self):
        with self.lock:
            self.set(0x6061, self.number(0x6060), 1)
            self.command()

    def heartbeat(self, cob, data, stamp):
        watched = self.number(0x1016, 1)
        if watched and (watched >> 16) & 0x7F == cob & 0x7F:
            self.heard = time.monotonic()

    def map(self, index):
        count = self.number(index, 0)
        return [self.number(index, sub) for sub in range(1, count + 1)]

    def told(self, cob, data, stamp):
        with self.lock:
            for n in range(4):
                if self.number(0x1400 + n, 1) == cob:
                    at = 0
                    for entry in self.map(0x1600 + n):
                        size = (entry & 0xFF) // 8
                        self.node.data_store.setdefault(entry >> 16, {})[(entry >> 8) & 0xFF] = bytes(data[at:at + size])
                        at += size
            self.command()

    def command(self):
        word = self.number(0x6040)
        rising, self.before = word & 0x80 and not getattr(self, "before", 0) & 0x80, word
        state = self.state
        if state == 0x08:
            if rising:
                self.enter(0x40)
            return
        if not word & 0x02:
            state = 0x40
        elif not word & 0x04:
            state = 0x07 if state == 0x27 else 0x40 if state != 0x07 else 0x07
        elif word & 0x0F == 0x06:
            state = 0x21
        elif word & 0x0F == 0x07:
            state = 0x23 if state in (0x21, 0x23, 0x27) else state
        elif word & 0x0F == 0x0F:
            state = 0x27 if state in (0x23, 0x27) else state
        self.enter(state)

    def sync(self, cob, data, stamp):
        with self.lock:
            now = time.monotonic()
            self.turn(now)
            self.set(0x6077, round(1000 * self.torque / RATED), 2, True)
            self.set(0x606C, round(self.speed / RPM100), 4, True)
            self.set(0x6064, int(self.angle // COUNT), 4, True)
            if self.node.nmt.state != "OPERATIONAL":
                return
            for n in range(4):
                cob = self.number(0x1800 + n, 1)
                if cob & 0x80000000 or self.number(0x1800 + n, 2) > 240:
                    continue
                parts = [self.get(entry >> 16, (entry >> 8) & 0xFF) for entry in self.map(0x1A00 + n)]
                self.network.send_message(cob, b"".join(parts))

    def turn(self, now):
        """The shaft goes on to an instant at the torque it has had."""
        h, self.last = now - self.last, now
        acceleration = (self.torque - 0.002 * self.speed) / INERTIA
        self.angle += h * (self.speed + 0.5 * h * acceleration)
        self.speed += h * acceleration
        self.torque = RATED * self.number(0x6071, 0, True) / 1000 if self.state == 0x27 else 0.0

    def watch(self):
        with self.lock:
            self.turn(time.monotonic())
            most = self.number(0x1016, 1) & 0xFFFF
            late = self.heard is not None and most and time.monotonic() - self.heard > most / 1000
            if late and self.state == 0x27:
                self.heard = None
                self.set(0x603F, 0x8130, 2)
                self.enter(0x08)


def connect(where):
    network = canopen.Network()
    if where.startswith("socketcan:"):
        network.connect(interface="socketcan", channel=where.removeprefix("socketcan:"))
    elif ":" in where:
        host, port = where.rsplit(":", 1)
        network.connect(interface="socketcand", host=host, port=int(port), channel="can0", tcp_tune=True)
    else:
        network.connect(interface="slcan", channel=where, bitrate=1_000_000, sleep_after_open=0.1)
    return network


def main(where, serial, lives):
    network = connect(where)
    drive = Drive(network, int(serial))
    drive.node.nmt.send_command(0)
    print("ready", flush=True)
    until = time.monotonic() + float(lives)
    while time.monotonic() < until:
        drive.watch()
        time.sleep(0.002)
    network.disconnect()


main(*sys.argv[1:])
