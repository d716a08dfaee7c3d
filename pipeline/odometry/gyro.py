"""Gyroscope: turn of the robot between two scans, and detection of wheel slip.

Slipping wheels measure a wrong turn; a gyroscope has a bias instead, which is estimated while the robot
stands still. Turn rates are about the vertical: (w_y sin roll + w_z cos roll) / cos pitch. A gyroscope can be
mounted upside down or measure degrees, so it is used only after its turns agree with those of the wheels.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from pipeline.geometry.poses import Pose2, wrap_angle
from pipeline.types.records import Imu, Turn

KEEP_NS = 3_000_000_000
GAP_NS = 60_000_000  # longest time between two readings over which the rate is integrated
AROUND_NS = 50_000_000  # half width of the interval for the rate at a stamp
BLOCK = 50  # consecutive readings for one estimate of the bias
BLOCKS_MOST = 20  # blocks that are averaged, because the bias drifts
STILL_SIGMA, STILL_MOST = 0.03, 0.1  # rad/s; largest standard deviation and mean of a block at rest
DEAD = 20  # equal consecutive readings after which the gyroscope is defective
NOISE = 1e-3  # rad/sqrt(s), MEMS gyroscope on a vibrating robot
SCALE = 0.01  # of the turn: one sigma of the scale error
# rad; the scale error is constant over a turn of this size, so the sigmas of its steps add up, not their
# variances (as for WANDERS and the bias).
SCALE_TURN = math.pi / 2.0
BIAS_UNKNOWN, BIAS_KNOWN = 0.01, 5e-4  # rad/s
WANDERS = 10.0  # s; the error of the bias is constant over this time, so short steps do not average it
CONTRADICTION, CONTRADICTION_LEAST = 4.0, 0.01  # sigma, rad
PROOF, ALIKE = 0.1, 3.0  # turn by the wheels [rad] and largest ratio for the gyroscope to agree with them
# rad; turn by LiDAR odometry after which turns of the opposite sense show a mirror image: ten times PROOF, as
# the map is called doubtful then.
MIRROR_PROOF = 1.0
# Smallest share of the specific force that is vertical, on average over the run: an axis within 25 degrees of
# gravity. Otherwise the attitude of the unit is unknown, and so is the sense of its turns.
UPRIGHT = 0.9
HALF_TRACK = 0.5  # m; slip of the wheels per angle of a wrong turn
SLIPPED = "the turns of the wheels and the gyroscope differ: the wheels slip"
UNUSED = "the turns of the LiDAR odometry and the gyroscope differ: the gyroscope is not used there"
MIRRORED = (
    "the LiDAR odometry turns against the gyroscope: one axis of the points has the wrong sign, and the map "
    "is a mirror image, or the gyroscope or the accelerometer has the wrong sign, and the map is right"
)


class Gyro:
    """Gyroscope readings of the last seconds, and the estimate of the bias."""

    def __init__(self) -> None:
        """Create an estimator without readings, with the bias 0, which is not proven."""
        self._readings: deque[tuple[int, float]] = deque()
        self._block: list[float] = []
        self._blocks, self._bias, self._scatter = 0, 0.0, 0.0
        self._same = 0
        self._turned = (0.0, 0.0, 0.0)
        self._proven = False
        self._force = (0.0, 0.0)  # sums of the vertical specific force, and of its absolute value

    def add(self, imu: Imu, tilt: tuple[float, float], *, standing: bool, needed_ns: int) -> None:
        """Add a finite reading that is later than the last one, as turn rate about the vertical; remove
        readings that are no longer needed, and estimate the bias while the robot stands still.

        Args:
            imu: The reading.
            tilt: Roll and pitch [rad].
            standing: Whether the robot stands still by its wheels.
            needed_ns: Readings from KEEP_NS before this time on are kept.
        """
        _, wy, wz = (float(w) for w in imu.angular_velocity)
        roll, pitch = tilt
        rate = (wy * math.sin(roll) + wz * math.cos(roll)) / max(math.cos(pitch), 0.1)
        last = self._readings[-1][1] if self._readings else math.nan
        self._same = self._same + 1 if rate == last else 0
        self._readings.append((imu.stamp_ns, rate))
        while self._readings[0][0] < min(needed_ns, imu.stamp_ns) - KEEP_NS:
            self._readings.popleft()
        self._learn_bias(rate, standing=standing)
        ax, ay, az = (float(a) for a in imu.linear_acceleration)
        vertical = (ay * math.sin(roll) + az * math.cos(roll)) * math.cos(pitch) - ax * math.sin(pitch)
        if math.isfinite(vertical):
            up, total = self._force
            self._force = (up + vertical, total + math.hypot(ax, ay, az))

    def forget_since(self, stamp_ns: int) -> None:
        """Remove the readings from a time [ns] on, whose stamps were wrong."""
        while self._readings and self._readings[-1][0] >= stamp_ns:
            self._readings.pop()

    def _learn_bias(self, rate: float, *, standing: bool) -> None:
        """Add a turn rate [rad/s] to the estimate of the bias. After BLOCK rates in a row at standstill,
        their mean and scatter, if below STILL_MOST and STILL_SIGMA, enter the running means of about the last
        BLOCKS_MOST blocks; a rate in motion discards the block."""
        if not standing:
            self._block.clear()
            return
        self._block.append(rate)
        if len(self._block) < BLOCK:
            return
        mean, sigma = float(np.mean(self._block)), float(np.std(self._block))
        self._block.clear()
        if sigma < STILL_SIGMA and abs(mean) < STILL_MOST:
            self._blocks = min(self._blocks + 1, BLOCKS_MOST)
            self._bias += (mean - self._bias) / self._blocks
            self._scatter += (sigma - self._scatter) / self._blocks

    @property
    def proven(self) -> bool:
        """Whether the rotations by the gyroscope have agreed with those by the wheels, see `compare`; it
        stays True."""
        return self._proven

    def compare(self, by_wheels: float, turn: Turn) -> None:
        """Add one step to the comparison of wheels and gyroscope, the slope of a line through all steps.

        The gyroscope is `proven` once the rotations by the wheels sum up to PROOF while the slope is between
        1 / ALIKE and ALIKE.

        Args:
            by_wheels: Rotation of the step by the wheels [rad].
            turn: Rotation of the same step by the gyroscope.
        """
        way, square, product = self._turned
        way, square = way + abs(by_wheels), square + by_wheels**2
        self._turned = (way, square, product + by_wheels * turn.angle)
        alike = square < ALIKE * self._turned[2] < ALIKE**2 * square
        self._proven = self._proven or (way >= PROOF and alike)

    @property
    def is_opposite(self) -> bool:
        """Whether the rotations by the gyroscope about the vertical, which the specific force gives, are
        opposite to those of the other source (see `compare`), which sum up to MIRROR_PROOF or more: the slope
        is between -ALIKE and -1 / ALIKE. False if gravity is not along the z axis."""
        way, square, product = self._turned
        up, total = self._force
        if way < MIRROR_PROOF or abs(up) <= UPRIGHT * total:
            return False
        return square < -ALIKE * math.copysign(product, product * up) < ALIKE**2 * square

    def turn(self, from_ns: int, to_ns: int) -> Turn | None:
        """Return the rotation between two times [ns] minus the bias [rad], with its sigma [rad]. None if
        readings are missing for more than GAP_NS or are constant, or if the times are not in order."""
        angle = self._integral(from_ns, to_ns)
        if angle is None:
            return None
        seconds = (to_ns - from_ns) * 1e-9
        angle -= self._bias * seconds
        bias_sigma = BIAS_UNKNOWN
        if self._blocks:
            bias_sigma = math.hypot(BIAS_KNOWN, self._scatter / math.sqrt(BLOCK * self._blocks))
        of_bias = bias_sigma**2 * seconds * max(seconds, WANDERS)
        variance = NOISE**2 * seconds + of_bias + SCALE**2 * abs(angle) * max(abs(angle), SCALE_TURN)
        return Turn(angle, math.sqrt(variance))

    def rate(self, stamp_ns: int) -> float | None:
        """Return the turn rate [rad/s] at a time [ns] minus the bias: the mean of the readings within
        AROUND_NS. None without such a reading, or if the readings are constant."""
        near = [rate for _, rate in self._between(stamp_ns - AROUND_NS, stamp_ns + AROUND_NS)]
        return None if not near or self._is_dead else float(np.mean(near)) - self._bias

    @property
    def _is_dead(self) -> bool:
        """Whether the last DEAD readings (or all, of fewer) are equal; True with a single reading that
        repeats the one before."""
        return self._same >= min(DEAD, max(len(self._readings) - 1, 1))

    def _between(self, from_ns: int, to_ns: int) -> list[tuple[int, float]]:
        """Return the readings, time [ns] and rate [rad/s], between two times [ns], both included, in the
        order of time."""
        found = []
        for reading in reversed(self._readings):
            if reading[0] < from_ns:
                break
            if reading[0] <= to_ns:
                found.append(reading)
        return found[::-1]

    def _integral(self, from_ns: int, to_ns: int) -> float | None:
        """Return the rotation [rad] between two times [ns], integrated by trapezoids; up to GAP_NS outside of
        the readings the rate is constant. None if the gap between readings exceeds GAP_NS, if the readings
        are constant (`_is_dead`), or if `to_ns` is not after `from_ns`."""
        inside = self._between(from_ns - GAP_NS, to_ns + GAP_NS)
        if self._is_dead or not inside or to_ns <= from_ns:
            return None
        at = np.array([(stamp - from_ns) * 1e-9 for stamp, _ in inside])
        end, gap = (to_ns - from_ns) * 1e-9, GAP_NS * 1e-9
        if at[0] > gap or at[-1] < end - gap or np.any(np.diff(at) > gap):
            return None
        grid = np.unique(np.concatenate([[0.0, end], at[(at > 0.0) & (at < end)]]))
        rates = np.interp(grid, at, [rate for _, rate in inside])
        return float(np.trapezoid(rates, grid))


def fused(
    step: Pose2, sigma: float, slack: tuple[float, float], turn: Turn
) -> tuple[Pose2, float, tuple[float, float], str]:
    """Fuse a step of the wheels with the rotation by the gyroscope.

    The two rotations are weighted by their inverse variances. If they differ by more than CONTRADICTION sigma
    and more than CONTRADICTION_LEAST, that of the gyroscope is used, and HALF_TRACK times the difference is
    added to the slack of the position. The translation is rotated by half of the correction.

    Args:
        step: Step by the wheels.
        sigma: Standard deviation of the rotation of the step by the wheels [rad].
        slack: Additional standard deviations of position [m] and heading [rad], see `Step`.
        turn: Rotation by the gyroscope.

    Returns:
        The corrected step, the standard deviation of its rotation [rad], the remaining slack (heading 0), and
        the message SLIPPED if the rotations contradict each other, else "".
    """
    of_wheels, of_gyro = sigma**2 + slack[1] ** 2, turn.sigma**2
    gap = float(wrap_angle(turn.angle - step.yaw))
    total = of_wheels + of_gyro
    if abs(gap) > max(CONTRADICTION * math.sqrt(total), CONTRADICTION_LEAST):
        return _turned(step, gap), turn.sigma, (math.hypot(slack[0], HALF_TRACK * gap), 0.0), SLIPPED
    share = of_wheels / total if total > 0.0 else 0.0
    return _turned(step, share * gap), math.sqrt(share * of_gyro), (slack[0], 0.0), ""


def _turned(step: Pose2, by: float) -> Pose2:
    """Return a step whose yaw is changed by an angle [rad], with its translation rotated by half of the
    angle; the yaw is wrapped."""
    c, s = math.cos(0.5 * by), math.sin(0.5 * by)
    return Pose2(c * step.x - s * step.y, s * step.x + c * step.y, float(wrap_angle(step.yaw + by)))
