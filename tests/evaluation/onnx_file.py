"""Small networks in ONNX, written by the field numbers of onnx.proto3."""

from pathlib import Path

import numpy as np

FLOAT = 1  # TensorProto.DataType


def write_network(
    path: Path, nodes: list[tuple[str, str, str]], inputs: dict[str, tuple[int | str, ...]]
) -> Path:
    """Write a network to `path`, and return the path.

    Nodes are (operator, names of inputs, name of the output). The last output is the output of
    the network.
    `channel_weights` [1, 3, 1, 1] = 1, 2, 4 can be an input of any node.
    """
    weights = np.array([1, 2, 4], np.float32).tobytes()
    shape = b"".join(_number(1, n) for n in (1, 3, 1, 1))
    constant = shape + _number(2, FLOAT) + _text(8, "channel_weights") + _bytes(9, weights)
    graph = b"".join(_bytes(1, _node(*node)) for node in nodes) + _text(2, "test")
    graph += _bytes(5, constant)
    graph += b"".join(_bytes(11, _tensor(name, shape)) for name, shape in inputs.items())
    graph += _bytes(12, _tensor(nodes[-1][2], None))
    path.write_bytes(_number(1, 8) + _bytes(8, _number(2, 13)) + _bytes(7, graph))
    return path


def _node(operator: str, inputs: str, output: str) -> bytes:
    return (
        b"".join(_text(1, name) for name in inputs.split()) + _text(2, output) + _text(4, operator)
    )


def _tensor(name: str, shape: tuple[int | str, ...] | None) -> bytes:
    kind = _number(1, FLOAT)
    if shape is not None:
        sides = (_number(1, n) if isinstance(n, int) else _text(2, n) for n in shape)
        kind += _bytes(2, b"".join(_bytes(1, side) for side in sides))
    return _text(1, name) + _bytes(2, _bytes(1, kind))


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _text(field: int, value: str) -> bytes:
    return _bytes(field, value.encode())


def _bytes(field: int, value: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(value)) + value


def _varint(value: int) -> bytes:
    out = []
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])
