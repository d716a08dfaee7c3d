"""The method of SLAM that the parameters name, behind one face."""

from __future__ import annotations

from pipeline.config.stages import Slam
from pipeline.geometry.poses import Float, Pose2
from pipeline.loop_closure.map_correction import Bend
from pipeline.slam.fastslam import FastSlam
from pipeline.slam.loop_correction import Loop
from pipeline.slam.motion import Motion
from pipeline.slam.pose_graph import GraphSlam, GraphState
from pipeline.slam.state import SlamState
from pipeline.types.pose_health import Health
from pipeline.types.records import Detections, Landmarks, PoseEstimate, PoseMeasurement

BackEndState = SlamState | GraphState


class BackEnd:
    """FastSLAM or the pose graph; one takes over from the other where the parameter changes in a run, with
    its map, its pose and its path as they are (see GraphState)."""

    def __init__(self, parameters: Slam, seed: int) -> None:
        self._seed = seed
        self._slam = _made(parameters, seed)

    @property
    def parameters(self) -> Slam:
        """In force; new ones act from the next scan on."""
        return self._slam.parameters

    @parameters.setter
    def parameters(self, parameters: Slam) -> None:
        state = self._slam.state
        if (parameters.method == "graph") != isinstance(self._slam, GraphSlam):
            self._slam = _made(parameters, self._seed)
        self._slam.parameters = parameters
        self.state = state

    @property
    def state(self) -> BackEndState:
        """All that is known between two scans; `copy()` makes it independent."""
        return self._slam.state

    @state.setter
    def state(self, state: BackEndState) -> None:
        p = self.parameters
        if isinstance(self._slam, GraphSlam):
            self._slam.state = state if isinstance(state, GraphState) else GraphState.of(state)
        elif isinstance(state, GraphState):
            self._slam.state = state.as_particles(p.particles, self._seed)
        else:
            self._slam.state = state

    @property
    def is_astray(self) -> bool:
        """Whether the known trees are not where they should be seen."""
        return self._slam.is_astray

    def process(
        self, index: int, motion: Pose2 | Motion, detections: Detections, clear_range: Float
    ) -> PoseEstimate:
        """See FastSlam.process."""
        return self._slam.process(index, motion, detections, clear_range)

    def as_seen(self, pose: PoseMeasurement) -> PoseMeasurement:
        """A measured pose without what all poses of its source are known by now to err by."""
        return self._slam.as_seen(pose)

    def place(self, index: int, T_map_base: Pose2, covariance: Float) -> None:
        """See FastSlam.place."""
        self._slam.place(index, T_map_base, covariance)

    def close(self, index: int, loop: Loop) -> Bend:
        """See FastSlam.close."""
        return self._slam.close(index, loop)

    def estimate(self, before: PoseEstimate) -> PoseEstimate:
        """After `place`: the pose, with the health of an estimate before it."""
        return self._slam.estimate(before)

    def lost(self, estimate: PoseEstimate) -> Health:
        """The health of an estimate that no tree has told anything of."""
        return self._slam.lost(estimate)

    def give_up(self) -> None:
        """Judge the health anew: what the known trees said no longer counts."""
        self._slam.give_up()

    def path(self) -> Float:
        """x, y [m], yaw [rad] at every scan, shape (N, 3)."""
        return self._slam.path()

    def begun_since(self, scan: int) -> tuple[Float, Float]:
        """See FastSlam.begun_since."""
        return self._slam.begun_since(scan)

    def landmarks(self) -> Landmarks:
        """Return all landmarks: of the best particle, or of the pose graph."""
        return self._slam.landmarks()


def _made(parameters: Slam, seed: int) -> FastSlam | GraphSlam:
    return GraphSlam(parameters) if parameters.method == "graph" else FastSlam(parameters, seed)
