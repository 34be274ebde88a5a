"""The way to a bus, for the scripts beside."""

import canopen


def connect(where):
    """To a link to a pseudo-terminal, to host:port of a TCP door, or to the interface of this name."""
    network = canopen.Network()
    if where.startswith("vcan"):
        network.connect(interface="socketcan", channel=where)
    elif ":" in where:
        host, port = where.rsplit(":", 1)
        network.connect(interface="socketcand", host=host, port=int(port), channel="can0", tcp_tune=True)
    else:
        network.connect(interface="slcan", channel=where, bitrate=1_000_000, sleep_after_open=0.1)
    return network
