"""Ports: serial ports, CAN buses and network sockets that stamp received data.

Each type of port has a separate module (`serial_port`, `can_bus`, `udp_socket`, `tcp_connection`).
A driver therefore imports only the libraries of the port that it uses.
"""

__all__: list[str] = []
