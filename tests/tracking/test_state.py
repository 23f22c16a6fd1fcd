from dataclasses import replace

import numpy as np

from ldo_service.tracking import PyramidConfig, pyramid_of
from ldo_service.tracking.keyframes import Keyframe
from ldo_service.tracking.state import State, packed, unpacked


def keyframes(room, n: int) -> tuple[Keyframe, ...]:
    view = pyramid_of(room.view(np.eye(4)), PyramidConfig())
    return tuple(Keyframe(view, np.eye(4), index) for index in range(n))


def test_empty_state_survives_packing() -> None:
    restored = unpacked(packed(State()), PyramidConfig())
    assert restored.keyframe is None
    assert restored.memory == ()


def test_current_keyframe_keeps_its_place_in_memory(room) -> None:
    known = keyframes(room, 3)
    state = State(memory=known, keyframe=known[1], frames_since_keyframe=4)
    restored = unpacked(packed(state), PyramidConfig())
    assert [k.id for k in restored.memory] == [0, 1, 2]
    assert restored.keyframe is restored.memory[1]
    assert restored.frames_since_keyframe == 4


def test_forgotten_current_keyframe_is_kept_beside_the_memory(room) -> None:
    known = keyframes(room, 3)
    restored = unpacked(
        packed(replace(State(), memory=known[1:], keyframe=known[0])), PyramidConfig()
    )
    assert [k.id for k in restored.memory] == [1, 2]
    assert restored.keyframe is not None
    assert restored.keyframe.id == 0
