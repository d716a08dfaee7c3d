"""A real file of each kind that can be read, short enough to be read thousands of times."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.benchmarks.cut_recordings import bag_of, plain_mcap_of, short_db3, short_pcap
from tests.benchmarks.mutating import read_all, read_cloud, with_sums

#: Kinds, the name of a damaged copy in its folder, and the function that reads it.
KINDS: dict[str, tuple[str, Callable[[Path], str]]] = {
    "ROS 2 MCAP": ("run.mcap", read_all),
    "MCAP, not packed": ("run.mcap", read_all),
    "ROS 2 db3": ("run.db3", read_all),
    "ROS 1 bag": ("run.bag", read_all),
    "ROS 1 bag, not packed": ("run.bag", read_all),
    "Velodyne pcap": ("run.pcap", read_all),
    "KITTI bin": ("0.bin", read_all),
    "PCD binary": ("0.pcd", read_all),
    "PCD ASCII": ("0.pcd", read_all),
    "LAZ": ("plot.laz", read_cloud),
    "LAS": ("plot.las", read_cloud),
    "E57": ("plot.e57", read_cloud),
    "E57, sums mended": ("plot.e57", read_cloud),
    "PLY": ("plot.ply", read_cloud),
    "NumPy npy": ("plot.npy", read_cloud),
    "NumPy npz": ("plot.npz", read_cloud),
    "Victoria Park zip": ("park.zip", read_all),
    "stems CSV": ("TreeManagerState_0.csv", lambda path: read_all(path.parent)),
    "poses TUM": ("poses.txt", lambda path: read_all(path.parent)),
}

#: Changes of a damaged copy by kind, so that the damage is not already found by a checksum.
AFTERWARDS: dict[str, Callable[[bytes], bytes]] = {"E57, sums mended": with_sums}


def real_file(kind: str, data: Path, folder: Path) -> bytes:
    """The contents of a real file of a kind, or of the first part of one; others beside it go to `folder`."""
    velodyne = data / "velodyne"
    match kind:
        case "ROS 2 MCAP":
            return (velodyne / "vlp16_ros2_mcap" / "vlp16_ros2_mcap.mcap").read_bytes()
        case "MCAP, not packed":
            return plain_mcap_of(velodyne / "vlp16_ros1.bag", folder / "cut.mcap")
        case "ROS 2 db3":
            return short_db3(velodyne / "vlp16_rosbag2" / "1673400471837873222_0.db3", folder / "cut.db3")
        case "ROS 1 bag" | "ROS 1 bag, not packed":
            return bag_of(velodyne / "vlp16_ros1.bag", folder / "cut.bag", packed=kind == "ROS 1 bag")
        case "Velodyne pcap":
            return short_pcap((velodyne / "vlp16.pcap").read_bytes(), share=0.5)
        case "KITTI bin":
            return (data / "kitti" / "000000.bin").read_bytes()[: 16 * 5_000]
        case "PCD binary":
            return (velodyne / "vlp16_reference.pcd").read_bytes()
        case "PCD ASCII":
            whole = (data / "sloam_forest" / "moving_ground_t0.pcd").read_bytes()
            return whole.replace(b"74521", b"2000")[:80_000].rpartition(b"\n")[0] + b"\n"
        case "Victoria Park zip":
            return _small_park(data, folder / "small.zip")
        case "stems CSV":
            first = (data / "oxford_evo" / "TreeManagerState_0.csv").read_bytes()
            (folder / "trajectory.txt").write_text("1 0 0 0 0 0 0 1\n")
            return first
        case "poses TUM":
            for k in range(3):
                np.save(folder / f"{k}.npy", np.ones((200, 3), np.float32) + k)
            return b"".join(b"%d.5 %d 0 0 0 0 0 1\n" % (1_600_000_000 + k, k) for k in range(3))
        case _:
            return _cloud(kind, data, folder)


def _small_park(data: Path, small: Path) -> bytes:
    with (
        zipfile.ZipFile(data / "victoria_park" / "victoria_park_ascii.zip") as whole,
        zipfile.ZipFile(small, "w", zipfile.ZIP_DEFLATED) as part,
    ):
        for name in ("LASER.txt", "DRS.txt", "GPS.txt"):
            part.writestr(name, whole.read(name)[:60_000])
    content = small.read_bytes()
    small.unlink()
    return content


def _cloud(kind: str, data: Path, folder: Path) -> bytes:
    """The first points of a real plot, written by laspy, Open3D or NumPy."""
    import laspy
    import open3d as o3d

    path = folder / KINDS[kind][0]
    with laspy.open(data / "forest" / "pine_plot.laz", laz_backend=laspy.LazBackend.Lazrs) as reader:
        las = laspy.LasData(reader.header, reader.read_points(5_000))
    if path.suffix in (".las", ".laz"):
        las.write(str(path))
    xyz = np.stack([las.x, las.y, las.z], axis=1)
    if path.suffix == ".ply":
        o3d.io.write_point_cloud(path, o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz)))
    elif path.suffix == ".e57":
        import pye57

        with_names = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), xyz.T, strict=True))
        file = pye57.E57(str(path), mode="w")
        file.write_scan_raw({name: np.ascontiguousarray(column) for name, column in with_names.items()})
        file.close()
    elif path.suffix == ".npy":
        np.save(path, xyz)
    elif path.suffix == ".npz":
        np.savez(path, points=xyz)
    return path.read_bytes()
