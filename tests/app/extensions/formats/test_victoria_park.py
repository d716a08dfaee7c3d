"""Victoria Park: the real zip, closed forms of the car's motion, and damaged zips."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.extensions.formats.victoria_park import Car, dead_reckoning, parse_numbers
from pipeline.errors import SourceError
from pipeline.types.records import Float, Odometry, Scan
from tests.pipeline.io.conftest import Opened


def test_the_real_recording_is_read_whole(shared_data: Path, opened: Opened):
    source = opened(shared_data / "victoria_park" / "victoria_park_ascii.zip")
    known = source.description
    assert (known.preset, known.scans, known.sensor.rings) == ("laser2d", 7230, 1)
    records = list(source.records())
    stamps = np.array([record.stamp_ns for record in records])
    scans = [record for record in records if isinstance(record, Scan)]
    poses = [record for record in records if isinstance(record, Odometry)]
    assert np.all(np.diff(stamps) >= 0)
    assert len(scans) == 7230
    assert stamps[0] == poses[0].stamp_ns <= scans[0].stamp_ns
    assert all(len(scan.points) + scan.dropped == 361 for scan in scans)
    assert np.all(scans[100].points[:, 2] == 0.0)
    assert source.losses == {}
    truth = source.truth()
    assert truth is not None
    gps = truth.path
    assert gps is not None
    assert not gps.same_frame
    # The last metre of 4 km of dead reckoning lies 235 m from GPS when the heading starts at 36 degrees.
    turn = np.radians(36.0)
    end = poses[-1].T_odom_base.t
    east, north = end[0] * np.cos(turn) - end[1] * np.sin(turn), end[0] * np.sin(turn) + end[1] * np.cos(turn)
    assert np.hypot(east - gps.x[-1], north - gps.y[-1]) == pytest.approx(235.0, abs=2.0)


def test_beams_go_from_right_to_left(tmp_path: Path, opened: Opened):
    ranges = np.full(361, 81.91)
    ranges[[0, 180, 360]] = [1.0, 2.0, 3.0]
    path = write_zip(tmp_path, np.concatenate([[0.5], ranges]))
    (scan,) = (record for record in opened(path).records() if isinstance(record, Scan))
    np.testing.assert_allclose(scan.points, [[0, -1, 0], [2, 0, 0], [0, 3, 0]], atol=1e-6)
    assert scan.dropped == 358


def test_times_of_all_files_are_seconds(tmp_path: Path, opened: Opened):
    laser = np.full((2, 362), 5.0)
    laser[:, 0] = [0.15, 12345.67]
    source = opened(write_zip(tmp_path, laser, "0.1 1 0\n12345.678 1 0\n", **{"GPS.txt": "0.25 5 7\n"}))
    stamps = {
        kind: [r.stamp_ns for r in source.records() if isinstance(r, kind)] for kind in (Scan, Odometry)
    }
    assert stamps == {
        Scan: [150_000_000, 12_345_670_000_000],
        Odometry: [100_000_000, 12_345_678_000_000],
    }
    assert (source.description.start_ns, source.description.end_ns) == tuple(stamps[Scan])
    truth = source.truth()
    assert truth is not None
    assert truth.path is not None
    assert truth.path.stamp_ns.tolist() == [250_000_000]


@given(st.floats(-5, 5), st.floats(-0.6, 0.6), st.integers(1, 400))
def test_steady_steering_drives_an_arc_of_one_centre(speed: float, steering: float, steps: int):
    car = Car()
    time = 0.025 * np.arange(steps + 1, dtype=np.float64)
    path = dead_reckoning(time, np.full(steps + 1, speed), np.full(steps + 1, steering), car)
    v_c = speed / (1 - np.tan(steering) * car.H / car.L)
    w = v_c * np.tan(steering) / car.L
    np.testing.assert_allclose(path[:, 2], w * time, atol=1e-9)
    # The rear axle's middle lies (-a, -b) from the laser in the car's axes.
    c, s = np.cos(path[:, 2]), np.sin(path[:, 2])
    rear = path[:, :2] + np.stack([-car.a * c + car.b * s, -car.a * s - car.b * c], axis=1)
    if abs(w) > 1e-3:
        centre = rear[0] + np.array([0.0, v_c / w])
        np.testing.assert_allclose(np.hypot(*(rear - centre).T), abs(v_c / w), rtol=1e-6)
    length = np.hypot(*np.diff(rear, axis=0).T).sum()
    assert length == pytest.approx(abs(v_c) * time[-1], rel=1e-3, abs=1e-9)


def test_a_finer_division_of_time_changes_nothing():
    rng = np.random.default_rng(1)
    speed, steering = rng.uniform(0, 3, 50), rng.uniform(-0.5, 0.5, 50)
    coarse = dead_reckoning(
        0.1 * np.arange(51, dtype=np.float64), np.append(speed, 0), np.append(steering, 0), Car()
    )
    fine = dead_reckoning(
        0.01 * np.arange(501, dtype=np.float64),
        np.append(np.repeat(speed, 10), 0),
        np.append(np.repeat(steering, 10), 0),
        Car(),
    )
    np.testing.assert_allclose(coarse, fine[::10], atol=1e-9)


def write_zip(folder: Path, laser: Float, drs: str = "0.1 1.0 0.0\n0.2 1.0 0.0\n", **more: str) -> Path:
    """A zip with one row of laser and the given encoders."""
    path = folder / "run.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data/LASER.txt", "\t".join(f"{number:.2f}" for number in laser.ravel()))
        archive.writestr("data/DRS.txt", drs)
        for name, text in more.items():
            archive.writestr(name, text)
    return path


def test_bad_rows_are_counted(tmp_path: Path, opened: Opened):
    rows = np.full((4, 362), 5.0)
    rows[:, 0] = [1.0, 2.0, 1.5, 3.0]
    laser = np.append(rows.ravel(), [4.0, 1.0])
    drs = "0.1 1 0\n0.2 1 9\n0.15 nan 0\n0.3 1 0\n0.25 1 0\n0.4"
    source = opened(write_zip(tmp_path, laser, drs))
    assert len([record for record in source.records() if isinstance(record, Scan)]) == 3
    assert source.truth() is None
    assert source.losses == {
        "numbers at the end of LASER.txt that are no whole scan": 2,
        "laser scans with impossible times": 1,
        "damaged rows of DRS.txt": 1,
        "encoder readings with impossible times": 2,
        "encoder readings out of bounds": 1,
    }


def test_what_comes_after_a_word_that_is_no_number_is_counted(tmp_path: Path, opened: Opened):
    text = "\t".join(["5"] * 362 + ["x"] + ["6"] * 361)
    path = tmp_path / "run.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("LASER.txt", text)
        archive.writestr("DRS.txt", "0.1 1.0 0.0\n")
    source = opened(path)
    assert source.description.scans == 1
    assert source.losses == {"words of LASER.txt from the first one that is not a number on": 362}


def test_a_gps_row_that_is_no_position_is_counted(tmp_path: Path, opened: Opened):
    gps = "0.1 1e200 0\n0.2 5 7\n0.3 0 -1e9\n0.4 6\n"
    source = opened(write_zip(tmp_path, np.full(362, 5.0), **{"GPS.txt": gps}))
    truth = source.truth()
    assert truth is not None
    assert truth.path is not None
    np.testing.assert_array_equal([truth.path.x, truth.path.y], [[7.0], [5.0]])
    assert source.losses == {"GPS rows with impossible positions": 2, "damaged rows of GPS.txt": 1}


def test_other_zips_and_empty_texts_are_refused(tmp_path: Path, opened: Opened):
    path = tmp_path / "other.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(SourceError, match=r"no LASER\.txt and DRS\.txt"):
        opened(path)
    with pytest.raises(SourceError, match=r"LASER\.txt holds no scan"):
        opened(write_zip(tmp_path, np.zeros(5)))
    with pytest.raises(SourceError, match=r"DRS\.txt holds no reading"):
        opened(write_zip(tmp_path, np.full(362, 5.0), drs="hello"))


def test_a_zip_bomb_is_refused_before_it_is_unpacked(tmp_path: Path, opened: Opened):
    path = tmp_path / "bomb.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("LASER.txt", "w", force_zip64=True) as member:
            for _ in range(65):
                member.write(bytes(1 << 20))
        archive.writestr("DRS.txt", "0 0 0")
    with pytest.raises(SourceError, match="unpacks to more than 64 MB"):
        opened(path)


@pytest.mark.parametrize("word", ["1.2.3", "-", "4e"])
def test_a_sequence_ends_at_the_first_word_that_is_not_a_number(word: str) -> None:
    numbers, left = parse_numbers(f"1 2\t{word} 3".encode())
    np.testing.assert_array_equal(numbers, [1.0, 2.0])
    assert left == 2


def test_a_long_sequence_is_split_between_words() -> None:
    expected = np.random.default_rng(1).uniform(-1e3, 1e3, 600_000)
    text = b"\t".join(b"%.9f" % number for number in expected)
    assert len(text) > 8 << 20
    numbers, left = parse_numbers(text)
    np.testing.assert_array_equal(numbers, [float(word) for word in text.split()])
    assert left == 0
    numbers, left = parse_numbers(b"1 x " + text)
    np.testing.assert_array_equal(numbers, [1.0])
    assert left == 1 + len(expected)
    assert len(parse_numbers(b"  \n")[0]) == 0
