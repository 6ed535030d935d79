"""Ports: serial ports, CAN buses and UDP sockets that stamp what arrives.

Each kind of port is a module of its own (`serial_port`, `can_bus`, `udp_socket`), so that a driver
imports only the libraries of the port it uses.
"""

__all__: list[str] = []
