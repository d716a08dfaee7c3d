"""The cloud of a run with the number of the tree of each point, read by laspy."""

from __future__ import annotations

import laspy
import numpy as np
import pytest

from app.batch.map_frame import MapFrame, write_map_frame
from app.batch.run_folder import read_run
from app.extensions.clouds.routes import cloud
from app.extensions.clouds.sources import open_cloud
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Pose2
from tests.app.cli.test_commands import stemmap


@pytest.mark.slow
def test_the_cloud_of_a_drive_has_its_trees_and_its_ground(tmp_path, capsys):
    run = tmp_path / "run"
    assert stemmap(capsys, "map", "sim:stand?duration=6", "--out", run).code == 0
    frame = MapFrame("EPSG:25832", Pose2(500_000.0, 5_300_000.0, np.pi / 2), 400.0, "hand")
    write_map_frame(run, frame.record())
    result = stemmap(capsys, "export", run, "--to", tmp_path / "cloud.laz")
    assert result.code == 0, result.err
    cloud = laspy.read(tmp_path / "cloud.laz")
    assert f"{len(cloud.points):,} points" in result.out
    assert cloud.header.parse_crs().to_epsg() == 25832
    place = np.stack([cloud.y - 5300000, -(cloud.x - 500000)], axis=1)  # the map is turned by 90 degrees
    trees = read_run(run).trees
    assert set(np.unique(cloud.tree)) <= {0, *trees.number.tolist()}
    near = 0
    for number, position, dbh in zip(trees.number, trees.position, trees.dbh, strict=True):
        of_tree = cloud.tree == number
        limit = 0.5 * dbh + 0.1 if np.isfinite(dbh) else 0.15
        distance = np.hypot(*(place[of_tree] - position).T)
        assert (distance <= limit + 0.01).all()
        near += int(of_tree.sum() > 20)
    assert near > 0.7 * len(trees.number)
    kinds = np.asarray(cloud.classification)
    assert set(np.unique(kinds)) == {1, 2, 5}
    np.testing.assert_array_equal(kinds == 5, np.asarray(cloud.tree) > 0)
    ground = np.asarray(cloud.z)[kinds == 2]
    assert np.abs(np.median(ground) - 400.0) < 1.5
    assert open_cloud(str(tmp_path / "cloud.laz")).description.cut_above
    again = tmp_path / "again.laz"
    assert stemmap(capsys, "export", run, "--to", again).code == 0
    assert again.read_bytes() == (tmp_path / "cloud.laz").read_bytes()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["again.laz", "cloud.laz", "run"]
    assert stemmap(capsys, "map", again, "--out", tmp_path / "whole").code == 3  # the cut is a warning
    assert stemmap(capsys, "export", tmp_path / "whole", "--to", tmp_path / "whole.laz").code == 0
    assert open_cloud(str(tmp_path / "whole.laz")).description.cut_above


def test_a_whole_cloud_keeps_its_points(tmp_path, capsys):
    random = np.random.default_rng(1)
    x, y = random.uniform(0, 8, (2, 20000))
    angle, z = random.uniform(0, 2 * np.pi, 8000), random.uniform(0, 6, 8000)
    trunk = np.stack([4 + 0.15 * np.cos(angle), 4 + 0.15 * np.sin(angle), z], axis=1)
    points = np.concatenate([np.stack([x, y, random.normal(0, 0.01, 20000)], axis=1), trunk])
    np.save(tmp_path / "plot.npy", points.astype(np.float32))
    assert stemmap(capsys, "map", tmp_path / "plot.npy", "--out", tmp_path / "run").code == 0
    result = stemmap(capsys, "export", tmp_path / "run", "--to", tmp_path / "cloud.las")
    assert result.code == 0, result.err
    cloud = laspy.read(tmp_path / "cloud.las")
    assert len(cloud.points) == len(points)
    np.testing.assert_allclose(np.stack([cloud.x, cloud.y, cloud.z], axis=1), points, atol=0.001)
    of_tree = np.asarray(cloud.tree) > 0
    assert of_tree[20000:].mean() > 0.95
    assert of_tree[:20000].sum() == 0
    assert not open_cloud(str(tmp_path / "cloud.las")).description.cut_above
    assert cloud.header.parse_crs() is None


@pytest.mark.parametrize("name", ["cloud.laz", "missing/cloud.laz"])
def test_a_source_that_is_gone_or_a_folder_that_is_not_there_is_one_line(tmp_path, capsys, name):
    from tests.app.batch.finished_runs import grid_run

    run = grid_run(tmp_path / "run")
    record = (run / "run.json").read_text().replace("sim:stand", "gone.mcap")
    (run / "run.json").write_text(record)
    result = stemmap(capsys, "export", run, "--to", tmp_path / name)
    result.refused(1)
    assert not (tmp_path / "cloud.laz").exists()


@pytest.mark.slow
def test_the_page_writes_the_same_bytes_and_refuses_a_live_run(tmp_path, capsys):
    run = tmp_path / "run"
    assert stemmap(capsys, "map", "sim:stand?duration=2", "--out", run).code == 0
    assert stemmap(capsys, "export", run, "--to", tmp_path / "line.laz").code == 0
    assert cloud({"path": str(run), "folder": str(tmp_path)}) == {"file": str(tmp_path / "cloud.laz")}
    assert (tmp_path / "cloud.laz").read_bytes() == (tmp_path / "line.laz").read_bytes()
    record = run / "run.json"
    record.write_text(record.read_text().replace("sim:stand?duration=2", "zenoh:tcp/127.0.0.1:7447"))
    with pytest.raises(StemmapError, match="a live run has no recording"):
        cloud({"path": str(run), "folder": str(tmp_path)})
