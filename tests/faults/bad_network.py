"""Two network namespaces, and a network between them that delays, loses and cuts packets.

The kernel of a test machine may have no netem. A thread therefore forwards the packets between two
TUN devices, one in each namespace. TCP of the kernel sees real losses and real delays. This needs
root, `ip`, `setpriv` and /dev/net/tun.

The end of the program ends the processes in the namespaces, even after SIGKILL. The namespaces
remain only after SIGKILL, and the next program deletes them.
"""

import ctypes
import fcntl
import heapq
import os
import random
import select
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event, Thread, current_thread, main_thread

# Names of the namespaces, which differ between programs that run at once.
ROBOT, HOST = f"ldo-robot-{os.getpid()}", f"ldo-host-{os.getpid()}"
ADDRESSES = {ROBOT: "10.213.7.1", HOST: "10.213.7.2"}
TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x0001, 0x1000  # See linux/if_tun.h.
CLONE_NEWNET = 0x40000000  # See setns(2).
MAX_PACKET = 1 << 16
TCP, RST = 6, 4
# Packets of a direction with a limited rate that wait, bytes; further ones are lost.
MAX_QUEUED_BYTES = 256_000


class NamespacesUnavailable(Exception):
    """Error of a machine without root, `ip`, `setpriv` or /dev/net/tun."""


@dataclass
class Direction:
    """State of the network in one direction; any thread may change it.

    Attributes:
        delay_s: Delay of each packet, seconds.
        loss: Probability that a packet is lost.
        is_cut: Whether all packets are lost.
        bytes_per_s: Rate, bytes per second; 0 for no limit.
    """

    delay_s: float = 0.0
    loss: float = 0.0
    is_cut: bool = False
    bytes_per_s: float = 0.0
    free_at_s: float = field(default=0.0, repr=False)  # End of the last packet, if limited.


class BadNetwork(Thread):
    """Thread that forwards the packets between both namespaces.

    Attributes:
        out: Direction from the robot to the other host.
        back: Direction from the other host to the robot.
        packets: Number of packets that came so far.
        lost: Number of those that were lost.
    """

    def __init__(self, seed: int, devices: tuple[int, int]) -> None:
        """Initialize; `start` forwards packets.

        Args:
            seed: Seed of the losses.
            devices: File descriptors of the TUN devices of robot and host.
        """
        super().__init__(daemon=True)
        self._rng, self._devices = random.Random(seed), devices
        self.out, self.back = Direction(), Direction()
        self.packets = self.lost = 0
        self._waiting: list[tuple[float, int, int, bytes]] = []
        self._ended, self._resets_until_s = Event(), 0.0

    def heal(self) -> None:
        """Forward all packets at once, from now on."""
        for way in (self.out, self.back):
            way.delay_s, way.loss, way.is_cut, way.bytes_per_s = 0.0, 0.0, False, 0.0

    def reset_connections(self, within_s: float = 1.0) -> None:
        """Reset each TCP connection that sends a packet within the given time."""
        self._resets_until_s = time.monotonic() + within_s

    def end(self) -> None:
        """End the thread."""
        self._ended.set()
        self.join()

    def run(self) -> None:
        """Forward packets until `end`."""
        while not self._ended.is_set():
            timeout_s = 0.1
            if self._waiting:
                timeout_s = min(timeout_s, max(0.0, self._waiting[0][0] - time.monotonic()))
            readable, _, _ = select.select(self._devices, (), (), timeout_s)
            for device in readable:
                self._read(device)
            now_s = time.monotonic()
            while self._waiting and self._waiting[0][0] <= now_s:
                _, _, target, packet = heapq.heappop(self._waiting)
                os.write(target, packet)

    def _read(self, device: int) -> None:
        way, target = (self.out, self._devices[1])
        if device == self._devices[1]:
            way, target = (self.back, self._devices[0])
        packet, now_s = os.read(device, MAX_PACKET), time.monotonic()
        if packet[0] >> 4 != 4:  # The kernel announces itself by IPv6.
            return
        self.packets += 1
        if now_s < self._resets_until_s and (answer := reset_of(packet)):
            os.write(device, answer)
        start_s = max(now_s, way.free_at_s)
        queued = (start_s - now_s) * way.bytes_per_s
        if way.is_cut or self._rng.random() < way.loss or queued > MAX_QUEUED_BYTES:
            self.lost += 1
            return
        if way.bytes_per_s:
            way.free_at_s = start_s = start_s + len(packet) / way.bytes_per_s
        heapq.heappush(self._waiting, (start_s + way.delay_s, self.packets, target, packet))


def reset_of(packet: bytes) -> bytes | None:
    """Return the packet with which the receiver of a TCP packet would reset the connection.

    The result is None for a packet that is not TCP, opens a connection, or is a reset itself.
    """
    words = 4 * (packet[0] & 15)
    if packet[9] != TCP or packet[words + 13] & 0b110:
        return None
    source, target = packet[12:16], packet[16:20]
    ports, acknowledged = packet[words : words + 4], packet[words + 8 : words + 12]
    tcp = struct.pack("!2s2s4sIBBHHH", ports[2:], ports[:2], acknowledged, 0, 5 << 4, RST, 0, 0, 0)
    pseudo = target + source + struct.pack("!BBH", 0, TCP, len(tcp))
    tcp = tcp[:16] + struct.pack("!H", _checksum(pseudo + tcp)) + tcp[18:]
    head = struct.pack("!BBHHHBBH4s4s", 0x45, 0, 20 + len(tcp), 0, 0, 64, TCP, 0, target, source)
    return head[:10] + struct.pack("!H", _checksum(head)) + head[12:] + tcp


def _checksum(data: bytes) -> int:
    """Return the checksum of RFC 1071."""
    total = sum(struct.unpack(f"!{len(data) // 2}H", data))
    total = (total >> 16) + (total & 0xFFFF)
    return ~(total + (total >> 16)) & 0xFFFF


@contextmanager
def two_namespaces(seed: int) -> Iterator[BadNetwork]:
    """Make both namespaces, and yield the network between them.

    Raises:
        NamespacesUnavailable: This machine cannot make them.
    """
    programs = shutil.which("ip") and shutil.which("setpriv")
    if os.geteuid() != 0 or not programs or not Path("/dev/net/tun").exists():
        raise NamespacesUnavailable(
            "two network namespaces need root, the programs ip (iproute2) and setpriv "
            "(util-linux), and /dev/net/tun (modprobe tun)"
        )
    delete_namespaces_of_ended_programs()
    with ExitStack() as stack:
        stack.enter_context(_exit_on_signals())
        devices = []
        try:
            for number, (name, address) in enumerate(ADDRESSES.items()):
                _ip("netns", "add", name)
                stack.callback(subprocess.run, ["ip", "netns", "del", name], check=False)
                device = os.open("/dev/net/tun", os.O_RDWR)
                stack.callback(os.close, device)
                devices.append(device)
                link = f"ldo{number}-{os.getpid()}"
                request = struct.pack("16sH22x", link.encode(), IFF_TUN | IFF_NO_PI)
                fcntl.ioctl(device, TUNSETIFF, request)
                _ip("link", "set", link, "netns", name)
                inside = ("-n", name)
                _ip(*inside, "address", "add", f"{address}/24", "dev", link)
                _ip(*inside, "link", "set", link, "up")
                _ip(*inside, "link", "set", "lo", "up")
                subprocess.run(command_in(name, "true"), check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError) as error:
            raise NamespacesUnavailable(f"network namespaces cannot be made: {error}") from error
        network = BadNetwork(seed, (devices[0], devices[1]))
        network.start()
        stack.callback(network.end)
        yield network


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


def delete_namespaces_of_ended_programs() -> None:
    """Delete the namespaces of programs that could not delete them, because they were killed."""
    for path in Path("/run/netns").glob("ldo-*"):
        name, _, pid = path.name.rpartition("-")
        if name in ("ldo-robot", "ldo-host") and not Path("/proc", pid).exists():
            subprocess.run(["ip", "netns", "del", path.name], check=False)


@contextmanager
def _exit_on_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the program as an exception does, so that it cleans up."""
    if current_thread() is not main_thread():
        yield
        return
    signals = (signal.SIGTERM, signal.SIGHUP)
    previous = [signal.signal(s, lambda number, _: sys.exit(128 + number)) for s in signals]
    try:
        yield
    finally:
        for number, handler in zip(signals, previous, strict=True):
            signal.signal(number, handler)


def command_in(namespace: str, *command: str) -> list[str]:
    """Return a command that runs another one in a namespace.

    The kernel kills that process when the calling thread ends.
    """
    return ["setpriv", "--pdeathsig", "KILL", "ip", "netns", "exec", namespace, *command]


def enter_namespace(name: str) -> None:
    """Move this thread into a namespace; threads and processes that it starts follow.

    Raises:
        OSError: The namespace cannot be entered.
    """
    with Path(f"/run/netns/{name}").open() as namespace:
        if ctypes.CDLL(None, use_errno=True).setns(namespace.fileno(), CLONE_NEWNET):
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number))
