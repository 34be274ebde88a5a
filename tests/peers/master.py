"""An independent CANopen master against the drives of `fric drives`.

Argument: a link to its pseudo-terminal, host:port of its TCP door, or the name of an interface. Boots node 3, reads its
objects, maps its PDOs, leads it to OPERATION ENABLED in mode 10 and through SYNC cycles with a set-point; prints what it
saw, one `name value` a line. Ends with code 0 only if all of it came as CiA 402 says.
"""

import struct
import sys
import time

import canopen

from network import connect

# Neither side need be prompt on a busy computer, or on an emulated one.
PATIENCE = 30


def dictionary():
    objects = canopen.ObjectDictionary()
    kinds = canopen.objectdictionary.datatypes
    for index, name, kind in [
        (0x1000, "device type", kinds.UNSIGNED32),
        (0x1008, "device name", kinds.VISIBLE_STRING),
        (0x1017, "heartbeat", kinds.UNSIGNED16),
        (0x6040, "control word", kinds.UNSIGNED16),
        (0x6041, "status word", kinds.UNSIGNED16),
        (0x6060, "mode", kinds.INTEGER8),
        (0x6061, "mode shown", kinds.INTEGER8),
        (0x6064, "position", kinds.INTEGER32),
        (0x606C, "speed", kinds.INTEGER32),
        (0x6071, "target torque", kinds.INTEGER16),
        (0x6077, "torque", kinds.INTEGER16),
        (0x6076, "rated torque", kinds.UNSIGNED32),
    ]:
        variable = canopen.objectdictionary.ODVariable(name, index, 0)
        variable.data_type = kind
        objects.add_object(variable)
    return objects


def main(where):
    network = connect(where)
    node = network.add_node(3, dictionary())
    node.sdo.RESPONSE_TIMEOUT = PATIENCE
    state = lambda: node.sdo[0x6041].raw & 0x6F

    node.nmt.send_command(0x82)
    node.nmt.wait_for_bootup(PATIENCE)
    assert node.sdo[0x1000].raw == 0x00020192, hex(node.sdo[0x1000].raw)
    # Longer than 4 bytes: a segmented transfer.
    print("name", node.sdo[0x1008].raw)
    print("rated", node.sdo[0x6076].raw)
    try:
        node.sdo.download(0x1000, 0, b"\0\0\0\0")
        raise AssertionError("a constant was written")
    except canopen.SdoAbortedError as abort:
        print("abort", hex(abort.code))

    write = lambda index, sub, number, size: node.sdo.download(index, sub, number.to_bytes(size, "little"))
    for base, cob, kind, entries in [
        (0x1400, 0x203, 255, [0x60400010, 0x60710010]),
        (0x1800, 0x183, 1, [0x60410010, 0x60770010, 0x606C0020]),
        (0x1801, 0x283, 1, [0x60640020]),
    ]:
        write(base, 1, cob | 0x80000000, 4)
        write(base + 0x200, 0, 0, 1)
        for sub, entry in enumerate(entries, 1):
            write(base + 0x200, sub, entry, 4)
        write(base + 0x200, 0, len(entries), 1)
        write(base, 2, kind, 1)
        write(base, 1, cob, 4)
    node.sdo[0x1017].raw = 50
    node.sdo[0x6060].raw = 10
    assert node.sdo[0x6061].raw == 10
    node.nmt.state = "OPERATIONAL"
    # One that was on its way may still tell of the state before.
    deadline = time.time() + PATIENCE
    while node.nmt.wait_for_heartbeat(PATIENCE) != "OPERATIONAL":
        assert time.time() < deadline, "stays " + node.nmt.state
    print("nmt", node.nmt.state)

    answers = {0x183: [], 0x283: []}
    for cob in answers:
        network.subscribe(cob, lambda id, data, stamp: answers[id].append(bytes(data)))
    for word, wanted in [(0x06, 0x21), (0x07, 0x23), (0x0F, 0x27)]:
        deadline = time.time() + PATIENCE
        while state() != wanted:
            assert time.time() < deadline, f"stays at {state():#x}"
            network.send_message(0x203, struct.pack("<Hh", word, 0))
            time.sleep(0.005)
        print("state", hex(wanted))
    cycles = 100
    for cycle in range(cycles):
        network.sync.transmit()
        network.send_message(0x203, struct.pack("<Hh", 0x0F, 100))
        time.sleep(0.002)
    deadline = time.time() + PATIENCE
    while min(map(len, answers.values())) < cycles and time.time() < deadline:
        time.sleep(0.01)
    # None too many.
    time.sleep(0.1)
    status, torque, speed = struct.unpack("<Hhi", answers[0x183][-1])
    positions = [struct.unpack("<i", data)[0] for data in answers[0x283]]
    print("answers", len(answers[0x183]), len(answers[0x283]))
    print("torque", torque)
    print("turned", (positions[-1] - positions[0] + 2**31) % 2**32 - 2**31)
    assert len(answers[0x183]) == cycles and len(answers[0x283]) == cycles, "an answer to each SYNC"
    assert status & 0x6F == 0x27 and status & 0x1000 and torque == 100 and speed > 0, (hex(status), torque, speed)
    network.send_message(0x203, struct.pack("<Hh", 0x02, 0))
    deadline = time.time() + PATIENCE
    while state() != 0x40 and state() & 0x4F != 0x40:
        assert time.time() < deadline, f"stays at {state():#x}"
        time.sleep(0.005)
    print("stopped", hex(state()))
    network.disconnect()


main(sys.argv[1])
