"""Reads the settings from the environment. `--help` does not import this module, so that it is quick."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from app.common.settings import DEFAULT_HOST, Files, Settings, data_folder, is_loopback
from pipeline.errors import StemmapError


class Environment(msgspec.Struct, frozen=True, rename=lambda name: f"STEMMAP_{name.upper()}"):
    """The variables of `app.common.settings.VARIABLES`, except that of the data folder."""

    host: str = DEFAULT_HOST
    port: Annotated[int, Meta(ge=0, le=65535)] | None = None
    token: Annotated[str, Meta(pattern=r"\A([A-Za-z0-9_-]{16,200})?\Z")] = ""
    hosts: str = ""
    recordings: str = ""
    database: str = ""
    files: Files = ""
    upload_gb: Annotated[float, Meta(gt=0.0, le=1e6)] = 20.0


def from_environment(environment: Mapping[str, str] | None = None) -> Settings:
    """Return the settings from the environment variables STEMMAP_*.

    Raises:
        StemmapError: A variable has an invalid value.
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
        database=given.database,
        files=given.files,
        upload_limit=round(1e9 * given.upload_gb),
    )
