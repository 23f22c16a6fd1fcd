from dataclasses import replace

import numpy as np

from ldo_service.tracking import PyramidConfig, pyramid_of
from ldo_service.tracking.keyframes import Keyframe
from ldo_service.tracking.moving import Suspicion
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


def test_what_moved_survives_packing(room) -> None:
    known, mask = keyframes(room, 2), np.eye(120, 160) > 0
    moved = replace(known[0], has_moved=mask, left_out=~mask)
    suspicion = Suspicion(mask, mask.astype(np.uint8))
    state = State(memory=(moved, known[1]), keyframe=moved, is_moving=~mask, suspicion=suspicion)
    restored = unpacked(packed(state), PyramidConfig())
    assert restored.keyframe is restored.memory[0]
    np.testing.assert_array_equal(restored.keyframe.left_out, ~mask)
    np.testing.assert_array_equal(restored.is_moving, ~mask)
    np.testing.assert_array_equal(restored.suspicion.gone, suspicion.gone)
    assert restored.memory[1].has_moved is None
