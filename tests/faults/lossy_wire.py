"""A wire between a GigE camera and its client that loses stream packets and has them sent again.

Aravis's camera simulator knows no PACKETRESEND command; this wire keeps what passed and answers it. It speaks
as little GVCP and GVSP as that takes (GigE Vision 2.0, chapters 15 and 24).
"""

from __future__ import annotations

import select
import socket
import struct
import threading
from collections.abc import Callable
from types import TracebackType

CONTROL_PORT = 3956
_READREG, _WRITEREG, _WRITEMEM, _RESEND = 0x0080, 0x0082, 0x0086, 0x0040
_CAPABILITY, _CAN_RESEND = 0x0934, 1 << 2
_STREAM_PORT, _STREAM_ADDRESS = 0x0D00, 0x0D18
_KEPT = 2000
"""Packets"""


class LossyWire:
    """At `address` instead of the camera's own. `loses(packet)`: of a frame's packets, when first sent."""

    def __init__(self, address: str = "127.0.0.2", camera: str = "127.0.0.1") -> None:
        self.loses: Callable[[int], bool] = lambda packet: False
        self.lost = self.sent_again = 0
        self._control = _bound(address, CONTROL_PORT)
        self._camera = _bound(camera, 0)
        self._camera.connect((camera, CONTROL_PORT))
        self._inlet, self._outlet = _bound(camera, 0), _bound(address, 0)
        self._inlet.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        self._client = ["", 0]
        """Address and port that want the stream"""
        self._kept: dict[tuple[int, int], bytes] = {}
        self._ended, self._end = socket.socketpair()
        self._threads = [threading.Thread(target=run) for run in (self._commands, self._packets)]
        for thread in self._threads:
            thread.start()

    def __enter__(self) -> LossyWire:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end.close()
        for thread in self._threads:
            thread.join()
        for link in (self._control, self._camera, self._inlet, self._outlet, self._ended):
            link.close()

    def _next(self, link: socket.socket) -> bool:
        """False when it is over."""
        ready, _, _ = select.select([link, self._ended], [], [])
        return self._ended not in ready

    def _commands(self) -> None:
        while self._next(self._control):
            request, client = self._control.recvfrom(2048)
            command = struct.unpack_from(">H", request, 2)[0]
            words = [w for (w,) in struct.iter_unpack(">I", request[8 : len(request) // 4 * 4])]
            if command == _RESEND:
                self._send_again(*words[:3])
                continue
            if command == _WRITEREG or (command == _WRITEMEM and len(words) == 2):
                request = request[:8] + struct.pack(f">{len(words)}I", *self._diverted(words))
            self._camera.send(request)
            answer = self._camera.recv(2048)
            if command == _READREG:
                values = [v for (v,) in struct.iter_unpack(">I", answer[8:])]
                can = [_CAN_RESEND if register == _CAPABILITY else 0 for register in words]
                told = [value | more for value, more in zip(values, can, strict=True)]
                answer = answer[:8] + struct.pack(f">{len(told)}I", *told)
            self._control.sendto(answer, client)

    def _diverted(self, words: list[int]) -> list[int]:
        """Pairs of register and value: the stream comes here instead of to the client."""
        host, port = self._inlet.getsockname()
        for at in range(0, len(words), 2):
            if words[at] == _STREAM_PORT and words[at + 1]:
                self._client[1], words[at + 1] = words[at + 1] & 0xFFFF, port
            elif words[at] == _STREAM_ADDRESS and words[at + 1]:
                self._client[0] = socket.inet_ntoa(words[at + 1].to_bytes(4, "big"))
                words[at + 1] = int.from_bytes(socket.inet_aton(host), "big")
        return words

    def _send_again(self, frame: int, first: int, last: int) -> None:
        for packet in range(first & 0xFFFFFF, (last & 0xFFFFFF) + 1):
            if (data := self._kept.get((frame & 0xFFFF, packet))) is not None:
                self.sent_again += 1
                self._outlet.sendto(data, (self._client[0], self._client[1]))

    def _packets(self) -> None:
        while self._next(self._inlet):
            data = self._inlet.recv(65_536)
            frame, packet = struct.unpack_from(">2xHI", data)
            self._kept[frame, packet & 0xFFFFFF] = data
            if len(self._kept) > _KEPT:
                self._kept.pop(next(iter(self._kept)))
            if self.loses(packet & 0xFFFFFF):
                self.lost += 1
            else:
                self._outlet.sendto(data, (self._client[0], self._client[1]))


def _bound(address: str, port: int) -> socket.socket:
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    link.bind((address, port))
    return link
