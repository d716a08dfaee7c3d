"""The address `sim:cloud?file=FILE` of a simulated drive through a whole cloud."""

from __future__ import annotations

from pipeline.errors import UsageError
from pipeline.simulation.scenarios import OPTIONS, SCHEME, RunRequest, option_values

#: Options of the address `sim:cloud`.
DRIVE_OPTIONS = {
    "file": (str, "the cloud of a plot: .laz, .las, .ply, .npy, .npz or .pcd"),
    "truth": (str, "a table (CSV) of its trees in the coordinates of the cloud"),
    **{key: OPTIONS[key] for key in ("seed", "sigma", "odometry", "duration")},
}


def parse_drive(uri: str, seed: int = 0) -> tuple[str, str, RunRequest]:
    """Return the file of the cloud, the table of its trees ("" for none), and the request of
    `sim:cloud?file=FILE&key=value`. Its duration is 0, for one loop, if the URI has none.

    Args:
        uri: As the user wrote it; the part after "?" is percent-encoded.
        seed: Seed of a URI that names none.

    Raises:
        UsageError: An option is unknown, given twice or out of bounds, or there is no file.
    """
    values = option_values(uri, uri.partition("?")[2], DRIVE_OPTIONS)
    if not values.get("file"):
        raise UsageError(
            "the cloud to be driven through is not named", where=uri, remedy="sim:cloud?file=plot.laz"
        )
    name = uri.partition("?")[0].removeprefix(SCHEME)
    quality = values.get("sigma", 0.02), values.get("odometry", "normal")
    request = RunRequest(name, values.get("seed", seed), *quality, values.get("duration", 0.0), 0)
    return values["file"], values.get("truth", ""), request
