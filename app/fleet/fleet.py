"""All robots: starts a dashboard for each, keeps what the page of the fleet is told."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Any

from app.common.settings import Settings
from app.dashboard.broadcast import Live
from app.dashboard.parameters import ParameterState
from app.fleet.frames import Frames
from app.fleet.member import Member, next_port
from app.fleet.payload import card, drawn, shown_map
from app.fleet.tasks import end
from app.fleet.warming import COMPILING
from app.web.app import MakeScene, MakeWorker, OfFleet, build
from app.web.connection_limits import Places
from app.worker.protocol import Open
from pipeline.errors import StemmapError

_log = logging.getLogger(__name__)

#: A worker and a port each: more than this no machine serves.
MOST_ROBOTS = 16
_CARDS_S, _MAPS_EACH, _FRAMES_EACH = 0.5, 2, 10  # maps and frames every so many rounds


class Fleet:
    """The members, by name, in the order in which they came.

    Args:
        settings: Of the deployment; port: of the fleet's own page.
        token: That browsers must show; the dashboards take the same.
        make_parameters: The parameters that a dashboard begins with.
        make_scene, make_worker: Stand in for viser and for the worker's process in tests.
        warm: The robots begin when this is done; None begins at once.
    """

    def __init__(
        self,
        settings: Settings,
        port: int,
        token: str,
        make_parameters: Callable[[], ParameterState] = ParameterState,
        make_scene: MakeScene | None = None,
        make_worker: MakeWorker | None = None,
        warm: Callable[[], Awaitable[None]] | None = None,
    ) -> None:
        self.live, self.pages = Live(), Places()
        self.members: dict[str, Member] = {}
        self.notice = ""
        self.remote: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {}  # card and map, mapped elsewhere
        self._settings, self._port, self._token = settings, port, token
        self._make_parameters = make_parameters
        self._make = (make_scene, make_worker)
        self._frames = Frames()
        self._warm, self._is_warm = warm, warm is None
        self._warming: asyncio.Task[None] | None = None
        self._task: asyncio.Task[None] | None = None
        self._laying: asyncio.Task[None] | None = None

    def add(self, name: str, source: Open) -> bool:
        """Begin with another robot; False when there is no room for it, which the page says."""
        if name in self.members:
            return True
        if len(self.members) >= MOST_ROBOTS:
            self.notice = f"There are more than {MOST_ROBOTS} robots; {name} and others are not shown"
            return False
        last = max([self._port, *(member.port for member in self.members.values())])
        try:
            listening = next_port(self._settings, last)
        except StemmapError as error:
            self.notice = f"{name} is not shown: {error}"
            return False
        app = build(
            replace(self._settings, port=listening.getsockname()[1]),
            port=listening.getsockname()[1],
            token=self._token,
            source=source,
            parameter_state=self._make_parameters(),
            make_scene=self._make[0],
            make_worker=self._make[1],
            fleet=OfFleet(self._port, self._open_records),
        )
        self.members[name] = Member(name, source, listening, app, self._settings)
        if self._is_warm:
            self.members[name].start()
        return True

    def start(self) -> None:
        """Begin to tell what becomes of them."""
        self._task = asyncio.create_task(self._tell_for_ever(), name="fleet")
        if self._warm is not None:
            self._warming = asyncio.create_task(self._begin_when_warm(self._warm()), name="warm")

    async def close(self) -> None:
        """End all of them at once."""
        for task in (self._warming, self._task, self._laying):
            await end(task)
        await asyncio.gather(*(member.close() for member in self.members.values()))

    async def _begin_when_warm(self, warming: Awaitable[None]) -> None:
        try:
            await warming
        except OSError:  # no process for it: the workers compile
            _log.exception("nothing was compiled before")
        self._is_warm = True
        for member in self.members.values():
            member.start()

    async def _tell_for_ever(self) -> None:
        rounds = 0
        while True:
            try:
                self.tell_cards()
                if rounds % _MAPS_EACH == 0:
                    self.tell_maps()
                if rounds % _FRAMES_EACH == 0 and (self._laying is None or self._laying.done()):
                    self._laying = asyncio.create_task(self._lay(), name="frames")
            except Exception:  # a fault in showing must not end the fleet
                _log.exception("the fleet could not be shown")
            rounds += 1
            await asyncio.sleep(_CARDS_S)

    async def _lay(self) -> None:
        try:
            await self._frames.try_one(self._maps())
        except Exception:  # the others are still to be laid
            _log.exception("a map could not be laid on the common one")

    def tell_cards(self) -> None:
        """Tell the browsers how the robots are."""
        cards = [card(name, m.dashboard) | {"answers": m.answers} for name, m in self.members.items()]
        for shown, member in zip(cards, self.members.values(), strict=True):
            if not self._is_warm:
                shown |= {"state": "starting", "detail": COMPILING, "source": member.source.uri}
            if member.ended:
                shown |= {"state": "failed", "detail": "Its dashboard ended; the terminal shows why"}
        cards += [shown for shown, _ in self.remote.values()]
        self.live.tell("fleet", {"members": cards, "notice": self.notice})

    def _open_records(self) -> set[int | None]:
        return {member.dashboard.logbook.record for member in self.members.values()}

    def tell_maps(self) -> None:
        """Tell the browsers the maps."""
        maps = {
            name: drawn(own, self._frames.pose(name), self._frames.how(name))
            for name, (_, own) in self._maps().items()
        }
        self.live.tell("maps", {"maps": maps})

    def _maps(self) -> dict[str, tuple[str, dict[str, Any]]]:
        """Digest and map of each robot that has one."""
        found = {name: (m.dashboard.digest, shown_map(m.dashboard)) for name, m in self.members.items()}
        maps = {name: (digest, own) for name, (digest, own) in found.items() if own is not None}
        return maps | {name: (f"remote:{name}", own) for name, (_, own) in self.remote.items()}
