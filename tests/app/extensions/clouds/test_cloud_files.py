"""Whole clouds in PLY, NumPy and PCD files written by another library; sizes in headers are not trusted."""

from __future__ import annotations

import io
import struct
import sys
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from app.cli import main
from app.extensions.clouds.point_cloud import offset_for, open_cloud
from app.extensions.clouds.sources import takes as is_cloud
from pipeline.errors import SourceError
from pipeline.io.readers.point_files import ScanFileError, open_table, read_columns
from tests.pipeline.plots import plot, write_las

UTM = np.array([470600.0, 3810200.0, 2278.0])
TEXT = (
    "ply\nformat ascii 1.0\nelement vertex {n}\n"
    "property float x\nproperty float y\nproperty float z\nend_header\n"
)


@pytest.fixture(scope="module")
def points():
    return plot(np.random.default_rng(1), per_m2=900)


def write(path: Path, points: np.ndarray, how: str = "") -> Path:
    """Write points with Open3D (PLY, PCD) or NumPy."""
    if path.suffix in (".ply", ".pcd"):
        import open3d as o3d

        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        ascii_, packed = how == "write_ascii", how == "compressed"
        assert o3d.io.write_point_cloud(path, cloud, write_ascii=ascii_, compressed=packed)
    elif path.suffix == ".npy":
        np.save(path, points)
    else:
        np.savez_compressed(path, other=np.arange(5), points=points)
    return path


@pytest.mark.slow_after(2)
@pytest.mark.parametrize(
    ("name", "how", "kind"),
    [
        ("c.ply", "", "PLY binary"),
        ("c.ply", "write_ascii", "PLY text"),
        ("c.pcd", "", "PCD binary"),
        ("c.pcd", "write_ascii", "PCD ascii"),
        ("c.pcd", "compressed", "PCD binary_compressed"),
        ("c.npy", "", "NumPy .npy"),
        ("c.npz", "", "NumPy .npz, its array points"),
    ],
)
def test_the_points_that_another_library_wrote(tmp_path, points, name, how, kind):
    points = points[::2]
    file = write(tmp_path / name, points, how)
    cloud = open_cloud(str(file))
    assert is_cloud(str(file))
    assert (cloud.description.kind, cloud.description.points) == (kind, len(points))
    for _ in range(2):  # as often as asked for
        read = np.concatenate(list(cloud.parts()))
        assert read.dtype == np.float32
        np.testing.assert_allclose(read, points, atol=1e-4)  # texts have six digits
    assert not cloud.losses


@pytest.mark.parametrize("name", ["c.ply", "c.las"])
def test_a_cloud_that_cannot_be_read_any_more_is_an_error_of_the_cloud(tmp_path, points, name):
    """The commands attribute an OSError to the folder of the results."""
    file = tmp_path / name
    write_las(file, points[:100]) if name == "c.las" else write(file, points[:100])
    cloud = open_cloud(str(file))
    file.unlink()
    with pytest.raises(SourceError, match="cannot read: No such file") as refusal:
        list(cloud.parts())
    assert refusal.value.where == str(file)


def test_a_package_that_is_missing_is_to_be_installed(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pye57", None)
    (tmp_path / "c.e57").write_bytes(b"ASTM-E57")
    with pytest.raises(SourceError, match=r"E57 files need pye57 .*\. Install it with: uv sync --extra e57$"):
        open_cloud(str(tmp_path / "c.e57"))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("order", ["C", "F"])
def test_numpy_tables_of_all_layouts(tmp_path, points, dtype, order):
    table = np.asarray(np.column_stack([points[:1000], np.arange(1000)]), dtype, order=order)
    np.save(tmp_path / "a.npy", table)
    np.savez(tmp_path / "b.npz", scan=table)
    np.savez(tmp_path / "c.npz", **dict(zip(("x", "y", "z", "intensity"), table.T, strict=True)))
    fields = np.zeros(1000, [("X", dtype), ("Y", dtype), ("name", "S3"), ("Z", dtype), ("Intensity", "u2")])
    for field, column in zip(("X", "Y", "Z", "Intensity"), table.T, strict=True):
        fields[field] = column
    np.save(tmp_path / "d.npy", fields)
    for name in ("a.npy", "b.npz", "c.npz", "d.npy"):
        columns = read_columns(open_table(tmp_path / name), {})
        assert set(columns) == {"x", "y", "z", "intensity"}, name
        for axis, column in zip(("x", "y", "z", "intensity"), table.T, strict=True):
            np.testing.assert_array_equal(columns[axis], column)


def test_coordinates_of_a_map_keep_their_millimetres(tmp_path, points):
    cloud = open_cloud(str(write(tmp_path / "c.npy", points + UTM)))
    read = np.concatenate(list(cloud.parts())) + cloud.description.offset
    assert np.abs(read - (points + UTM)).max() < 1e-4


@pytest.mark.parametrize("order", ["<", ">"])
def test_ply_of_both_byte_orders_with_other_elements_before_and_after(tmp_path, order):
    form = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    head = (
        f"ply\r\nformat {form} 1.0\r\ncomment made by hand\r\nelement camera 2\r\nproperty double t\r\n"
        "element vertex 3\r\nproperty uchar red\r\nproperty double x\r\nproperty float y\r\n"
        "property short z\r\n"
        "property float scalar_Intensity\r\nelement face 1\r\n"
        "property list uchar int vertex_indices\r\nend_header\r\n"
    )
    rows = [(1, 1.5, -2.0, 3, 0.25), (2, 4.5, 5.0, -6, 0.5), (3, 7.0, 8.0, 9, 0.75)]
    body = struct.pack(order + "2d", 0.0, 1.0)
    body += b"".join(struct.pack(order + "Bdfhf", *row) for row in rows)
    body += struct.pack(order + "B3i", 3, 0, 1, 2)
    (tmp_path / "c.ply").write_bytes(head.encode() + body)
    columns = read_columns(open_table(tmp_path / "c.ply"), {})
    read = np.column_stack([columns[name] for name in ("red", "x", "y", "z", "intensity")])
    np.testing.assert_array_equal(read, rows)


@pytest.mark.parametrize("end", ["", "\r\n"])
def test_a_ply_text_is_read_to_its_last_line(tmp_path, end):
    text = TEXT.format(n=2).replace("element", "element note 1\nproperty float n\nelement", 1)
    (tmp_path / "c.ply").write_text(text + "7\n1 2 3\n4 5 6" + end)
    losses: dict[str, int] = {}
    columns = read_columns(open_table(tmp_path / "c.ply"), losses)
    np.testing.assert_array_equal(columns["z"], [3.0, 6.0])
    assert not losses


@pytest.mark.parametrize(
    ("body", "x"),
    [("1 2 3\n4 5 x\n7 8 9\n", [1.0, 7.0]), ("1 2 3\n4 5\n6 7 8 9\n", [1.0]), ("1 2 3\n4 5\n", [1.0])],
)
def test_damaged_and_missing_rows_of_a_text_are_counted(tmp_path, body, x):
    (tmp_path / "c.ply").write_text(TEXT.format(n=3) + body)
    losses: dict[str, int] = {}
    columns = read_columns(open_table(tmp_path / "c.ply"), losses)
    np.testing.assert_array_equal(columns["x"], x)
    assert losses == {"points that the files promise but do not hold": 3 - len(x)}


def test_what_stands_before_the_points_of_a_text_is_passed_over_once(tmp_path):
    """Two million short lines: copying the rest of the text at each of them would take minutes."""
    lines = 2_000_000
    text = TEXT.format(n=2).replace("element", f"element note {lines}\nproperty float n\nelement", 1)
    (tmp_path / "c.ply").write_bytes(text.encode() + b"7\n" * lines + b"1 2 3\n4 5 6\n")
    np.testing.assert_array_equal(read_columns(open_table(tmp_path / "c.ply"), {})["x"], [1.0, 4.0])


@pytest.mark.parametrize("body", ["1 2 3 4\n4 5 6 7\n", "\n1 2 3 4 5 6\n"])
def test_rows_longer_than_the_header_says_are_refused(tmp_path, body):
    (tmp_path / "c.ply").write_text(TEXT.format(n=2) + body)
    with pytest.raises(ScanFileError, match=r"have [46] numbers, its header names 3"):
        read_columns(open_table(tmp_path / "c.ply"), {})


def test_points_that_are_none_are_counted(tmp_path, points):
    some = points[:500].copy()
    some[3], some[7, 1] = np.nan, 1e12
    cloud = open_cloud(str(write(tmp_path / "c.npy", some)))
    assert sum(len(part) for part in cloud.parts()) == 498
    assert cloud.losses == {"points without coordinates": 2}


@pytest.mark.parametrize("name", ["c.ply", "c.pcd", "c.npy"])
def test_a_file_that_is_cut_gives_what_is_there(tmp_path, points, name):
    file = write(tmp_path / name, points[:10_000])
    file.write_bytes(file.read_bytes()[:-1000])
    cloud = open_cloud(str(file))
    read = np.concatenate(list(cloud.parts()))
    assert 9_900 < len(read) < 10_000
    np.testing.assert_allclose(read, points[: len(read)], atol=2e-5)
    assert cloud.losses == {"points that the files promise but do not hold": 10_000 - len(read)}


def npy(shape, dtype="<f4", fortran=False):
    """A header alone."""
    file = io.BytesIO()
    header = {"descr": dtype, "fortran_order": fortran, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue()


REFUSED = {
    "objects.npy": npy((2, 3), "|O") + b"\x80\x04.",
    "too_many.npy": npy((1 << 60, 3)) + bytes(12),
    "columns.npy": npy((1 << 30, 3), "<f8", fortran=True) + bytes(24),
    "two.npy": npy((50, 2)) + bytes(400),
    "complex.npy": npy((50, 3), "<c8") + bytes(1200),
    "text.npy": npy((50,), "<U8") + bytes(1600),
    "empty.npy": npy((0, 3)),
    "nothing.npy": npy((5, 3)),
    "header.npy": b"\x93NUMPY\x01\x00\x10\x00{'descr': [[[[[[",
    "no_zip.npz": b"PK\x03\x04" + bytes(40),
    "few.ply": TEXT.format(n=1 << 40).encode(),
    "lists.ply": TEXT.format(n=3).replace("float z", "list uchar int z").encode() + b"1 2 1 3\n",
    "flat.ply": TEXT.format(n=1).replace("float z", "float w").encode() + b"1 2 3\n",
    "rows.ply": TEXT.format(n=2).encode() + b"1 2 3 4\n4 5 6 7\n",
    "kind.ply": TEXT.format(n=1).replace("float z", "real z").encode() + b"1 2 3\n",
    "form.ply": TEXT.format(n=1).replace("ascii", "xml").encode() + b"1 2 3\n",
    "endless.ply": b"ply\n" + b"comment \n" * 10_000,
    "huge.pcd": b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 99999999999999\n"
    b"HEIGHT 1\nPOINTS 99999999999999\nDATA binary\n" + bytes(24),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_read_is_one_line_and_leaves_no_folder(tmp_path, capsys, name):
    (tmp_path / name).write_bytes(REFUSED[name])
    arguments = ["map", str(tmp_path / name), "--as", "cloud", "--out", str(tmp_path / "out")]
    assert main(arguments) == 1
    told = capsys.readouterr().err
    assert told.count("\n") == 1, told
    assert not (tmp_path / "out").exists()


def test_an_archive_that_would_unpack_to_more_than_it_says_stays_small(tmp_path):
    with zipfile.ZipFile(tmp_path / "c.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", npy((1 << 28, 3)) + bytes(1 << 20))
    with pytest.raises(ScanFileError, match="too many for one scan"):
        read_columns(open_table(tmp_path / "c.npz"), {})
    cloud = open_cloud(str(tmp_path / "c.npz"))
    assert sum(len(part) for part in cloud.parts()) == (1 << 20) // 12


@pytest.mark.slow
def test_damaged_files_never_crash(tmp_path, points):
    rng = np.random.default_rng(5)
    for name in ("c.ply", "c.npy", "c.npz", "c.pcd"):
        whole = write(tmp_path / name, points[:2000]).read_bytes()
        for k in range(150):
            content = bytearray(whole[: int(rng.integers(1, len(whole)))] if k % 3 == 0 else whole)
            for at in rng.integers(0, min(len(content), 400 if k % 2 else len(content)), 6):
                content[at] = int(rng.integers(0, 256))
            (tmp_path / name).write_bytes(bytes(content))
            with suppress(SourceError):
                assert sum(len(part) for part in open_cloud(str(tmp_path / name)).parts()) <= 2000
            with suppress(ScanFileError):
                read_columns(open_table(tmp_path / name), {})


@given(
    arrays.arrays(
        np.float64,
        3,
        elements=st.one_of(st.sampled_from([0.0, 999.0, 1000.0, -1000.0, 1230.0]), st.floats(-1e7, 1e7)),
    )
)
def test_large_coordinates_are_reduced_by_whole_hundreds_of_metres(middle):
    offset = offset_for(middle)
    small = np.abs(middle) < 1000.0
    assert (offset[small] == 0.0).all()
    assert (np.abs(middle - offset)[~small] <= 50.0).all()
    assert (np.remainder(offset, 100.0) == 0.0).all()


def ply_with_lists(order: str, before: bool, points: np.ndarray, rng: np.random.Generator) -> bytes:
    """A binary PLY file whose vertices have two lists, one before z; with an element of lists before them."""
    form = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    head = f"ply\nformat {form} 1.0\n"
    body = bytearray()
    if before:
        head += "element camera 7\nproperty float f\nproperty list uchar short name\n"
        for k in range(7):
            body += struct.pack(f"{order}fB{k}h", 1.5, k, *range(k))
    head += (
        f"element vertex {len(points)}\nproperty float x\nproperty double y\n"
        "property list ushort int views\nproperty float z\nproperty list uchar double weights\n"
        "property uchar red\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
    )
    counts = rng.integers(0, 5, (len(points), 2))
    for k, ((x, y, z), (a, b)) in enumerate(zip(points.tolist(), counts.tolist(), strict=True)):
        body += struct.pack(f"{order}fdH{a}ifB{b}dB", x, y, a, *range(a), z, b, *[0.5] * b, k % 256)
    return head.encode() + bytes(body)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("before", [False, True])
def test_ply_with_lists_in_and_before_its_vertices(tmp_path, order, before, monkeypatch):
    monkeypatch.setattr("app.extensions.clouds.ply._WALKED", 70_000)  # in several parts
    rng = np.random.default_rng(4)
    points = rng.uniform(-9.0, 9.0, (5000, 3))
    (tmp_path / "c.ply").write_bytes(ply_with_lists(order, before, points, rng))
    cloud = open_cloud(str(tmp_path / "c.ply"))
    assert cloud.description.attributes == ("red",)
    for _ in range(2):
        np.testing.assert_allclose(np.concatenate(list(cloud.parts())), points, atol=1e-5)
    assert cloud.losses == {}


def test_a_cut_or_damaged_ply_with_lists_gives_the_points_before(tmp_path):
    rng = np.random.default_rng(4)
    points = rng.uniform(-9.0, 9.0, (500, 3))
    whole = ply_with_lists("<", True, points, rng)
    (tmp_path / "c.ply").write_bytes(whole[: len(whole) // 2])
    cloud = open_cloud(str(tmp_path / "c.ply"))
    read = np.concatenate(list(cloud.parts()))
    assert 100 < len(read) < 400
    np.testing.assert_allclose(read, points[: len(read)], atol=1e-5)
    assert cloud.losses == {"points that the files promise but do not hold": 500 - len(read)}
    for k in range(150):
        content = bytearray(whole)
        for at in rng.integers(0, 500 if k % 2 else len(content), 5):
            content[at] = int(rng.integers(0, 256))
        (tmp_path / "c.ply").write_bytes(bytes(content))
        with suppress(SourceError):
            assert sum(len(part) for part in open_cloud(str(tmp_path / "c.ply")).parts()) <= 500


def test_ply_text_with_a_list_after_the_coordinates(tmp_path, points):
    some = points[:2000]
    head = TEXT.format(n=2000).replace("end_header", "property list uchar int views\nend_header")
    lines = [f"{x:.4f} {y:.4f} {z:.4f} {k % 3}{' 5' * (k % 3)}" for k, (x, y, z) in enumerate(some)]
    (tmp_path / "c.ply").write_text(head + "\n".join(lines))
    read = np.concatenate(list(open_cloud(str(tmp_path / "c.ply")).parts()))
    np.testing.assert_allclose(read, some, atol=1e-4)
    (tmp_path / "c.ply").write_text(
        head.replace("property float x\n", "property list uchar int views\nproperty float x\n")
    )
    with pytest.raises(SourceError, match=r"a list before x, y and z.*Export it"):
        open_cloud(str(tmp_path / "c.ply"))
