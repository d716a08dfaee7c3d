"""The simulated run as a source: order, random access, reproducible bytes."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import pytest

from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import SourceOptions
from pipeline.io.readers.simulated import open_simulated
from pipeline.simulation.run import START_NS
from pipeline.types.records import Imu, Odometry, Record, Scan

SHORT = "sim:stand?duration=2"


def bytes_of(record: Record) -> bytes:
    if isinstance(record, Scan):
        columns = (record.points, record.reflectance, record.ring, record.offset_ns)
        return b"".join(column.tobytes() for column in columns if column is not None)
    if isinstance(record, Odometry):
        return record.T_odom_base.R.tobytes() + record.T_odom_base.t.tobytes()
    assert isinstance(record, Imu)
    orientation = np.zeros(4) if record.orientation is None else record.orientation
    parts = (record.angular_velocity, record.linear_acceleration, orientation)
    return b"".join(np.ascontiguousarray(part).tobytes() for part in parts)


def stream_of(records: Iterable[Record]) -> list[tuple[str, int, bytes]]:
    return [(type(record).__name__, record.stamp_ns, bytes_of(record)) for record in records]


def test_records_come_in_the_order_of_time_at_their_rates():
    source = open_simulated(SHORT)
    records = list(source.records())
    assert all(a.stamp_ns <= b.stamp_ns for a, b in pairwise(records))
    assert source.description.scans == 20
    assert source.description.start_ns == START_NS
    assert source.description.end_ns == START_NS + 1_900_000_000
    for kind, count in ((Scan, 20), (Odometry, 101), (Imu, 201)):
        stamps = [record.stamp_ns for record in records if isinstance(record, kind)]
        assert len(stamps) == count
        assert len(set(np.diff(stamps))) == 1
    # At the same time the scan comes last, when all that is needed to place it is there.
    assert [type(record) for record in records[:3]] == [Imu, Odometry, Scan]
    assert source.losses == {}
    source.close()
    source.close()


@pytest.mark.parametrize(("seconds", "scans"), [("1", 10), ("2.3", 23), ("4.35", 43), ("33", 330)])
def test_a_run_has_ten_scans_a_second(seconds, scans):
    assert open_simulated(f"sim:paper?duration={seconds}").description.scans == scans


def test_the_first_odometry_is_the_identity():
    for options in ("", "&odometry=exact"):
        record = open_simulated(SHORT + options).run.odometry_record(0)
        np.testing.assert_allclose(record.T_odom_base.t, 0.0, atol=1e-12)
        # The exact pose also has the tilt of the ground.
        assert record.T_odom_base.euler()[2] == pytest.approx(0.0, abs=1e-12)


def test_same_seed_same_bytes_and_another_seed_others():
    one, again = (stream_of(open_simulated(SHORT + "&seed=5").records()) for _ in range(2))
    other = stream_of(open_simulated(SHORT + "&seed=6").records())
    assert one == again
    for name in ("Scan", "Odometry", "Imu"):
        ours = [row for row in one if row[0] == name]
        theirs = [row for row in other if row[0] == name]
        assert ours != theirs


def test_seed_from_the_options_is_that_of_the_uri():
    by_options = open_simulated(SHORT, SourceOptions(seed=5))
    by_uri = open_simulated(SHORT + "&seed=5")
    assert by_options.description.digest == by_uri.description.digest
    assert bytes_of(by_options.run.sweep(3).scan) == bytes_of(by_uri.run.sweep(3).scan)


def test_any_scan_can_be_made_alone():
    in_order = [record for record in open_simulated(SHORT).records() if isinstance(record, Scan)]
    alone = open_simulated(SHORT).run
    for k in (13, 2, 19, 0):
        assert bytes_of(alone.sweep(k).scan) == bytes_of(in_order[k])


def test_a_longer_run_begins_as_a_shorter_one():
    short, long = (open_simulated(f"sim:stand?duration={s}").run for s in (2, 20))
    assert bytes_of(short.sweep(15).scan) == bytes_of(long.sweep(15).scan)


def test_digest_tells_runs_apart():
    uris = [SHORT, SHORT + "&seed=1", SHORT + "&sigma=0.03", SHORT + "&odometry=poor", SHORT + "&trees=40"]
    uris.append("sim:slope?duration=2")
    digests = {open_simulated(uri).description.digest for uri in uris}
    assert len(digests) == len(uris)
    assert all(len(digest) == 64 for digest in digests)


def test_noise_and_wheels_do_not_move_the_trees():
    plain = open_simulated(SHORT).run.scene.truth
    for more in ("&sigma=0.03", "&odometry=poor"):
        np.testing.assert_array_equal(open_simulated(SHORT + more).run.scene.truth.x, plain.x)


def test_the_lidar_stands_where_it_is_mounted():
    mounting = Pose3.from_euler(np.array([0.2, 0.0, 1.5]), 0.0, 0.0, 0.5)
    source = open_simulated("sim:paper", SourceOptions(T_base_lidar=mounting))
    assert source.description.T_base_lidar is mounting
    got = source.run.sweep(0)
    ground = got.scan.points[got.solid == -2]
    assert np.median(ground[:, 2]) == pytest.approx(-1.5, abs=0.02)
    assert source.description.digest != open_simulated("sim:paper").description.digest


def test_points_are_finite_and_in_range():
    for uri in ("sim:dense?seed=3", "sim:slope", "sim:long"):
        source = open_simulated(uri)
        for k in (0, 200, 555):
            scan = source.run.sweep(k).scan
            distance = np.linalg.norm(scan.points, axis=1)
            assert np.isfinite(scan.points).all()
            assert distance.min() >= 0.5 - 1e-5
            assert distance.max() <= 100.0 + 1e-4
            assert len(scan.points) > 10_000
            assert scan.reflectance is not None
            assert scan.reflectance.min() >= 0.0
            assert scan.reflectance.max() <= 255.0
            assert scan.points.dtype == np.float32


def test_truth_has_the_path_at_the_scans():
    source = open_simulated("sim:slope?odometry=exact&duration=20")
    path = source.truth().path
    assert path is not None
    assert path.same_frame
    assert (path.x[0], path.y[0], path.yaw[0]) == (0.0, 0.0, 0.0)
    assert len(path.x) == 200
    for k in range(200):
        record = source.run.odometry_record(5 * k)
        assert record.stamp_ns == path.stamp_ns[k]
        pose = record.T_odom_base
        expected = [path.x[k], path.y[k], path.yaw[k]]
        np.testing.assert_allclose([*pose.t[:2], pose.euler()[2]], expected, atol=1e-9)


def test_another_drive_goes_through_the_same_scene_with_other_noise():
    first, same, other = (open_simulated(SHORT + more) for more in ("", "&drive=0", "&drive=1"))
    assert first.description.digest == same.description.digest != other.description.digest
    a, b = first.run.scene.truth, other.run.scene.truth
    assert np.array_equal(a.x, b.x)
    assert np.array_equal(a.dbh, b.dbh, equal_nan=True)
    assert not np.array_equal(first.run.odometry, other.run.odometry)
    assert bytes_of(first.run.sweep(3).scan) == bytes_of(same.run.sweep(3).scan)
    assert bytes_of(first.run.sweep(3).scan) != bytes_of(other.run.sweep(3).scan)


def test_the_digest_of_a_run_stays():
    """Annotations are stored under it."""
    digest = open_simulated("sim:stand").description.digest
    assert digest == "20aaf691b64d334ac0964c25ce925c772bbfca80ff978965b9a7de70067222c5"
