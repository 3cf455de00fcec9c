"""Over TraCI's connections many commands are one message, and wrong ones are said as before."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

traci = pytest.importorskip("traci", reason="needs the extra sumo")
connection_module = pytest.importorskip("traci.connection")

from cfx_sumo.live.orders import set_speeds  # noqa: E402 - traci may be missing


class Server:
    """Answers every command of a TraCI client, one of them with an error."""

    def __init__(self, fails_at: int | None = None) -> None:
        self.messages: list[int] = []
        self._fails_at = fails_at
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._socket.getsockname()[1]
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        client, _ = self._socket.accept()
        with client, self._socket:
            while head := client.recv(4):
                body = b""
                while len(body) < struct.unpack("!i", head)[0] - 4:
                    body += client.recv(65536)
                client.sendall(self._answer(body))

    def _answer(self, body: bytes) -> bytes:
        said, count = b"", 0
        while body:
            wrong = sum(self.messages) + count == self._fails_at
            text = b"no such vehicle" if wrong else b""
            said += struct.pack("!BBBi", 7 + len(text), body[1], 255 if wrong else 0, len(text))
            said += text
            body = body[body[0] :]
            count += 1
        self.messages.append(count)
        return struct.pack("!i", 4 + len(said)) + said


@contextmanager
def connected(server: Server) -> Iterator[Any]:
    connection = connection_module.Connection("127.0.0.1", server.port, None, None, False)
    yield connection
    connection._socket.close()


def test_speeds_of_many_vehicles_are_few_messages() -> None:
    server = Server()
    with connected(server) as connection:
        set_speeds(connection, [f"car{number}" for number in range(1200)], np.full(1200, 3.0))
        connection.vehicle.setSpeed("car0", 4.0)
    assert server.messages == [500, 500, 200, 1]


def test_a_vehicle_that_sumo_does_not_know_is_an_error_and_the_connection_goes_on() -> None:
    server = Server(fails_at=2)
    with connected(server) as connection:
        with pytest.raises(traci.TraCIException, match="no such vehicle"):
            set_speeds(connection, ["a", "b", "nobody", "c"], np.array([1.0, 2.0, 3.0, 4.0]))
        set_speeds(connection, ["a"], np.array([5.0]))
    assert server.messages == [4, 1]
