"""Settings of a deployment, separate from the mapping parameters.

Each setting has an environment variable; command-line flags take precedence over `from_environment`.
"""

from __future__ import annotations

import ipaddress
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import msgspec
from msgspec import Meta

from pipeline.errors import StemmapError

# Environment variables and their descriptions, from which the help text is made.
VARIABLES: dict[str, str] = {
    "STEMMAP_HOST": "address to listen on, a loopback one (another needs the flag --host)",
    "STEMMAP_PORT": "port to listen on",
    "STEMMAP_TOKEN": "token of the link, 16 or more letters, digits, - and _; else a new one at each start",
    "STEMMAP_HOSTS": "further host names by which browsers may call the server, with commas between",
    "STEMMAP_RECORDINGS": "folder whose recordings the page offers",
    "STEMMAP_FOLDER": "folder for runs, annotations and uploads (default: stemmap in your folder for data)",
    "STEMMAP_FILES": "files that the owner's link may open: any, or folders (only those in the data folders);"
    " default: any for requests from this machine, folders for others; set folders behind a proxy or tunnel",
    "STEMMAP_EXTENSIONS": "extensions that are switched on, with commas between; empty: none (default: all)",
    "STEMMAP_UPLOAD_GB": "largest recording that a browser may upload, in GB (default: 20)",
    "STEMMAP_RUN_GB": "temporary files of a run, from which it is shown and mapped again, in GB (default: 2)",
    "STEMMAP_RUN_MEMORY_MB": "memory of a run from which its trees are made again, in MB (default: 450)",
}

Files = Literal["", "any", "folders"]

#: Largest body of a request that is no upload, and largest websocket message of a browser [bytes].
BODY_LIMIT = MESSAGE_LIMIT = 1_000_000
DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 8000


class RunBudget(NamedTuple):
    """What a run keeps at most to go back and to map again without its source [bytes]. There are up to three
    maps (the current one, that before the last change, one in the making) and three sets of segmented scans.

    Attributes:
        files: Temporary files.
        memory: What the trees of the maps are made of.
    """

    files: int = 2_000_000_000
    memory: int = 450_000_000

    @property
    def scans(self) -> int:
        """Share of the files for the scans of the source; of 2 GB, for the last five minutes of a VLP-16."""
        return 7 * self.files // 16

    @property
    def results(self) -> int:
        """Share of the files for the results of one map; of 2 GB, for ten minutes with 18 kB a scan. A
        sixteenth of the files is left to states of the mapper."""
        return self.files // 18

    @property
    def segmented(self) -> int:
        """Share of the files for the scans that are segmented with one set of parameters; of 2 GB, for ten
        minutes with 37 kB a scan."""
        return self.files // 9

    @property
    def tree_log(self) -> int:
        """Share of the memory for one map; of 450 MB, for ten minutes of a dense forest (130 MB)."""
        return self.memory // 3


DEFAULT_BUDGET = RunBudget()


@dataclass(frozen=True, slots=True)
class RunStorage:
    """What a run keeps at present, in files and in memory, and at most [bytes]; see `RunBudget`."""

    files: int
    memory: int
    most_files: int
    most_memory: int


@dataclass(frozen=True, slots=True)
class Settings:
    """How the server runs.

    Attributes:
        host: Address on which it listens.
        port: Port on which it listens; 0 for any free port, None for the default port or one of the next.
        token: Token of the owner's link; empty for a new one.
        hosts: Further host names by which browsers may call the server.
        recordings: Folder whose recordings the dashboard offers, or None.
        folder: Folder of runs, annotations and uploads; None keeps them in memory.
        upload_limit: Maximum size of an uploaded recording [bytes].
        files: Files that an owner may open: "any", "folders" (recordings in the data folders), or "" for any
            file in requests from this machine and only the data folders in others.
        opens_browser: Whether the page is opened in the browser of this machine.
        prints_viewer_link: Whether the view-only link is printed at the start.
        run_budget: What a run keeps at most.
    """

    host: str = DEFAULT_HOST
    port: int | None = None
    token: str = ""
    hosts: tuple[str, ...] = ()
    recordings: Path | None = None
    upload_limit: int = 20_000_000_000
    folder: Path | None = None
    files: Files = ""
    opens_browser: bool = False
    prints_viewer_link: bool = False
    run_budget: RunBudget = DEFAULT_BUDGET

    @property
    def uploads(self) -> Path | None:
        """Folder of uploaded recordings, which need not exist: that of the recordings, else one in the data
        folder; None without both."""
        return self.recordings or (self.folder and self.folder / "recordings")

    @property
    def data_folders(self) -> tuple[Path, ...]:
        """Existing folders whose recordings and finished runs the page offers: `recordings` and the folder
        recordings in the data folder."""
        named = (self.recordings, self.folder and self.folder / "recordings")
        return tuple(dict.fromkeys(folder for folder in named if folder is not None and folder.is_dir()))

    @property
    def loopback(self) -> bool:
        """Whether only this machine can connect."""
        return is_loopback(self.host)


def is_loopback(host: str) -> bool:
    """Return whether an address or name is a loopback address; False for names other than "localhost"."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def recordings_place(settings: Settings, now_s: float) -> Path:
    """Return the path of a new recording in the data folder, for example
    recordings/live-20260102-030405.mcap, by the time in UTC. Nothing is created.

    Args:
        settings: Settings of the deployment.
        now_s: Time in the name of the recording [s since 1970].

    Raises:
        StemmapError: There is no data folder.
    """
    if settings.folder is None:
        raise StemmapError(
            "there is no data folder for a recording",
            remedy="Leave out the recording, set STEMMAP_FOLDER, or name a file: --record FILE.mcap",
        )
    return settings.folder / "recordings" / time.strftime("live-%Y%m%d-%H%M%S.mcap", time.gmtime(now_s))


def data_folder(given: Mapping[str, str]) -> Path | None:
    """Return the data folder: STEMMAP_FOLDER (a leading ~ is the home folder of the process), else `stemmap`
    in XDG_DATA_HOME, LOCALAPPDATA or ~/.local/share, whichever is known first; None if there is none. Empty
    variables count as unknown; the folder need not exist.

    Args:
        given: The environment variables; HOME, else USERPROFILE, is the home folder of ~/.local/share.
    """
    if named := given.get("STEMMAP_FOLDER"):
        return Path(named).expanduser()
    home = given.get("HOME") or given.get("USERPROFILE")
    base = given.get("XDG_DATA_HOME") or given.get("LOCALAPPDATA") or (home and f"{home}/.local/share")
    return Path(base) / "stemmap" if base else None


class Environment(msgspec.Struct, frozen=True, rename=lambda name: f"STEMMAP_{name.upper()}"):
    """The variables of `app.common.settings.VARIABLES`, except that of the data folder."""

    host: str = DEFAULT_HOST
    port: Annotated[int, Meta(ge=0, le=65535)] | None = None
    token: Annotated[str, Meta(pattern=r"\A([A-Za-z0-9_-]{16,200})?\Z")] = ""
    hosts: str = ""
    recordings: str = ""
    files: Files = ""
    upload_gb: Annotated[float, Meta(gt=0.0, le=1e6)] = 20.0
    run_gb: Annotated[float, Meta(gt=0.0, le=1e6)] = 2.0
    run_memory_mb: Annotated[float, Meta(gt=0.0, le=1e6)] = 450.0


def from_environment(environment: Mapping[str, str] | None = None) -> Settings:
    """Return the settings from the environment variables of VARIABLES, with defaults for those that are not
    set. No folder is created.

    Args:
        environment: The variables; None for those of this process.

    Raises:
        StemmapError: A variable has an invalid value, the host is not a loopback address, or the folder of
            recordings does not exist.
    """
    variables = os.environ if environment is None else environment
    try:
        given = msgspec.convert(dict(variables), Environment, strict=False)
    except msgspec.ValidationError as error:
        what, _, name = str(error).partition(" - at `$.")
        text = variables.get(name.rstrip("`"), "")
        raise StemmapError(f"{text!r} is invalid: {what}", where=name.rstrip("`")) from None
    if not is_loopback(given.host):
        raise StemmapError(
            f"{given.host} is not a loopback address",
            where="STEMMAP_HOST",
            remedy="Use the flag --host for it",
        )
    recordings = Path(given.recordings).expanduser() if given.recordings else None
    if recordings is not None and not recordings.is_dir():
        raise StemmapError(f"{recordings} is not a folder", where="STEMMAP_RECORDINGS")
    return Settings(
        host=given.host,
        port=given.port,
        token=given.token,
        hosts=tuple(name.strip().lower() for name in given.hosts.split(",") if name.strip()),
        recordings=recordings,
        folder=data_folder(variables),
        files=given.files,
        upload_limit=round(1e9 * given.upload_gb),
        run_budget=RunBudget(round(1e9 * given.run_gb), round(1e6 * given.run_memory_mb)),
    )
