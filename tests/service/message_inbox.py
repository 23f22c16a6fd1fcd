"""Inbox for the poses, label requests and label results of a live service."""

from contextlib import ExitStack

import numpy as np

from ldo_service.conversions.poses import keyframe_poses_from_correction
from ldo_service.detection.vocabulary import Vocabulary
from ldo_service.gaussians.model import GaussianMap
from ldo_service.schemas import GraphCorrection, InputCount, LabelRequest, LabelResult, TrackedPose
from ldo_service.schemas.topics import GRAPH_CORRECTION, POSE_TRACKED
from ldo_service.storage.state_store import FolderStore
from tests.service.conftest import LiveService
from tests.service.failure_artifacts import Guide


class Heard:
    """Messages received so far; call `listen` often. `guide` receives each label request."""

    def __init__(self, service: LiveService, stack: ExitStack, guide: Guide | None = None) -> None:
        self.service, self._guide = service, guide
        self.poses: list[TrackedPose] = []
        self.frame_of: dict[int, int] = {}  # Frame number by keyframe.
        self.requests: list[LabelRequest] = []
        self.answers: list[LabelResult] = []
        self.late: list[int] = []  # Latency of each answer, in keyframes.
        listen = service.client.poller
        self._requests = stack.enter_context(listen("label/request", LabelRequest))
        self._answers = stack.enter_context(listen("label/result", LabelResult))

    def listen(self) -> None:
        requests = self._requests()  # Poses of their keyframes were published before.
        for pose in self.service.poses():
            self._take(pose)
        for request in requests:
            self.requests.append(request)
            if self._guide:
                self._guide.add_request(request, self.frame_of[request.keyframe])
        for answer in self._answers():
            self.answers.append(answer)
            self.late.append(max(self.frame_of) - answer.keyframe)

    def _take(self, pose: TrackedPose) -> None:
        self.poses.append(pose)
        if pose.keyframe is not None:
            self.frame_of[pose.keyframe] = pose.frame

    def ask_again(self) -> None:
        """Query the last pose, in case it was lost."""
        for pose in self.service.client.latest(POSE_TRACKED):
            assert isinstance(pose, TrackedPose)
            if pose.frame > max((known.frame for known in self.poses), default=-1):
                self._take(pose)

    def has_all_answers(self) -> bool:
        """Return whether each label request is answered and the mapper has received the result."""
        self.listen()
        labeller = self.service.update_health()["vlm_labeller"]
        asked, taken = (
            self.input("vlm_labeller", "label/request"),
            self.input("mapper", "label/result"),
        )
        is_idle = labeller.state == "ready" and asked.queued == 0
        return is_idle and asked.delivered == taken.delivered + taken.dropped + taken.lost

    def input(self, actor: str, topic: str) -> InputCount:
        """Return the counters of an input as of the last heartbeat."""
        inputs = self.service.update_health()[actor].inputs
        return next(count for count in inputs if count.topic == topic)

    def fact(self, actor: str, name: str) -> float:
        return self.service.update_health()[actor].metrics.get(name, 0.0)

    def graph(self) -> dict[int, np.ndarray]:
        """Return T_map_keyframe [4, 4] by keyframe from the optimizer."""
        (correction,) = self.service.client.latest(GRAPH_CORRECTION)
        assert isinstance(correction, GraphCorrection)
        return keyframe_poses_from_correction(correction)

    def map(self) -> tuple[GaussianMap, tuple[str, ...]]:
        """Return the map as the mapper saves it, and the names of its labels."""
        answer = self.service.client.control("save")
        assert answer.ok, answer.message
        state = FolderStore(self.service.state / "state").load("mapper")
        assert state is not None
        saved = state["map"]
        vocabulary = Vocabulary.unpack(saved["semantics"]["vocabulary"])
        return GaussianMap.restore(saved["map"]["map"]), vocabulary.names
