"""The 3D scene and its panel."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import secrets
from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from app.scene.camera import WORLD, Follower
from app.scene.error_node import ErrorNode
from app.scene.hotkeys import add_hotkeys
from app.scene.map_cloud import Accumulated, MapCloud
from app.scene.map_nodes import MapNodes, Ring
from app.scene.robot_nodes import ROBOT, RobotNodes
from app.scene.scan_nodes import ScanNodes, Vector
from app.scene.server import silenced, start_server
from app.scene.tune_panel import TunePanel
from app.scene.tuning import SceneCommands, Tuning, Value
from app.scene.view import View
from app.scene.voxel_node import VoxelNode
from app.scene.way_node import WayNode
from pipeline.config import Parameters, preset
from pipeline.geometry.poses import Pose2
from pipeline.types.records import Frame, TruthTrees

Float = NDArray[np.float64]

# A browser that comes late walks through every message number that was ever given out: 50 million took 17 s.
RENEW_AFTER = 2_000_000


class Scene:
    """Shows frames in viser and carries what people do there to the server.

    All methods are called on `loop`. What viser calls in its own thread crosses over to `loop` first, so
    that no two threads ever touch the nodes.

    Args:
        commands: What the scene asks of the server.
        loop: The server's loop.
    """

    def __init__(self, commands: SceneCommands, loop: asyncio.AbstractEventLoop) -> None:
        self.secret = secrets.token_urlsafe(32)
        self._commands, self._loop = commands, loop
        self._view = View()
        self._tuning = Tuning(commands, self._put_back)
        self._parameters, self._preset = preset("forest"), "forest"
        self._frame: Frame | None = None
        self._path: Float = np.zeros((0, 2))
        self._truth: TruthTrees | None = None
        self._selected: int | None = None
        self._ring: Ring = None
        self._accumulated = Accumulated()
        self._build()

    @property
    def port(self) -> int:
        """Where viser listens on 127.0.0.1. It changes when the scene renews itself: read it each time."""
        return self._server.get_port()

    @property
    def messages(self) -> int:
        """Message numbers that viser has given out since it started."""
        return self._server._websock_server.get_message_buffer().message_counter

    def show(self, frame: Frame, path: Float) -> None:
        """Show what came of a scan.

        Args:
            frame: The results.
            path: shape (N, 2) [m], where the robot was at each scan, in the frame of the map.
        """
        self._frame, self._path = frame, np.asarray(path, dtype=np.float64).reshape(-1, 2)
        if self.messages > RENEW_AFTER:
            self._renew()
            return
        self._show_frame()

    def show_parameters(self, parameters: Parameters, preset_name: str) -> None:
        """Move the sliders to what holds now, without calling back."""
        self._parameters, self._preset = parameters, preset_name
        with self._server.atomic():
            self._tune.show(parameters, preset_name, self._tuning.moving)

    def show_truth(self, trees: TruthTrees | None) -> None:
        """Show the ground truth; None takes it away."""
        self._truth = trees
        with self._server.atomic():
            self._map.show_truth(trees)

    def select(self, tree: int | None, ring: Ring = None) -> None:
        """Mark a tree by its number and a cluster by a ring around it: x, y and radius [m] in the frame of
        the map. None marks none."""
        self._selected, self._ring = tree, ring
        if self._frame is not None:  # the scan is large and does not change by this
            with self._server.atomic():
                self._map.repaint(self._frame, tree, ring, self._view)

    @property
    def view(self) -> dict[str, Any]:
        """What people chose to see, for the page."""
        return {**self._view.as_plain(), "counts": self.counts}

    @property
    def counts(self) -> dict[str, int]:
        """How much the layers show of which only the scene knows."""
        return {
            "ground": self._map.ground.faces,
            "voxels": self._voxels.count,
            "gathered": self._gathered.count,
            "errors": self._errors.count,
        }

    def choose(self, name: str, value: str | bool) -> None:
        """Show or hide a layer, follow the robot or not, or colour and label by something else.

        Raises:
            ParameterError: There is no such choice.
        """
        self._view.choose(name, value)
        self._repaint()

    def clear(self) -> None:
        """Forget the run: an empty scene, the panel as it is."""
        self._frame, self._path = None, np.zeros((0, 2))
        self._truth = self._selected = self._ring = None
        self._accumulated = Accumulated()
        with self._server.atomic():
            self._server.scene.reset()
            self._add_nodes()

    def close(self) -> None:
        """Stop viser."""
        self._tuning.stop()
        with silenced():
            self._server.stop()

    # --- building ------------------------------------------------------------------------------

    def _build(self) -> None:
        self._server = start_server(self.secret)
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(0, 105, 78))
        gui.main_panel.dock_right()
        gui.main_panel.set_width(330)
        self._tune = TunePanel(
            gui, self._parameters, self._preset, self._on_change, self._on_preset, self._on_reset
        )
        add_hotkeys(gui, self._on_camera, functools.partial(self._cross, self._on_follow))
        self._add_nodes()

    def _add_nodes(self) -> None:
        scene = self._server.scene
        scene.set_up_direction("+z")
        scene.configure_default_lights(enabled=True, cast_shadow=False)
        self._follower = Follower(self._server)
        scene.add_grid(
            f"{WORLD}/ground",
            infinite_grid=True,
            cell_size=1.0,
            section_size=10.0,
            cell_color=(112, 116, 122),  # between the two themes, for both
            cell_thickness=0.4,
            section_color=(96, 101, 108),
            section_thickness=1.0,
            fade_distance=60.0,
            shadow_opacity=0.0,
        )
        self._robot = RobotNodes(scene)
        self._scan = ScanNodes(scene, ROBOT, functools.partial(self._cross, self._on_cluster))
        self._map = MapNodes(scene, functools.partial(self._cross, self._on_tree))
        self._voxels = VoxelNode(scene, f"{ROBOT}/scan")
        self._gathered = MapCloud(scene, self._accumulated)
        self._errors = ErrorNode(scene)
        self._way = WayNode(scene, ROBOT)

    def _renew(self) -> None:
        old = self._server
        # Browsers lose their connection when the old one stops, and find the new port through the bridge.
        self._build()
        self._map.show_truth(self._truth)
        self._show_frame()
        with silenced():
            old.stop()

    # --- showing -------------------------------------------------------------------------------

    @property
    def _pose(self) -> Pose2:
        return Pose2() if self._frame is None else self._frame.estimate.T_map_base

    @property
    def _base_z(self) -> float:
        return 0.0 if self._frame is None else self._frame.base_z

    def _show_frame(self) -> None:
        if self._frame is None:
            return
        with self._server.atomic():  # or the points would run ahead of the robot
            self._follower.show(self._pose, self._base_z, self._view.follow)
            # First, because all else stands on its ground.
            self._map.show(self._frame, self._selected, self._ring, self._view)
            self._robot.show(self._frame, self._path, self._view, self._map.ground)
            self._scan.show(self._frame, self._view)
            self._gathered.show(self._frame, self._view.layers["gathered"])
            self._show_more(self._frame)

    def _show_more(self, frame: Frame) -> None:
        """The layers that are made only while people want to see them."""
        size = self._parameters.filters.voxel_size
        self._voxels.show(frame.filtered, size, self._view.layers["voxels"])
        self._way.show(frame.clearance, self._parameters.obstacles, self._view.layers["way"])
        if self._view.layers["errors"]:
            wanted = self._parameters.evaluation
            self._errors.show(frame.trees, self._truth, self._path, wanted, self._map.ground)
        else:
            self._errors.hide()

    def _repaint(self) -> None:
        if self._frame is None:
            return
        with self._server.atomic():
            self._follower.show(self._pose, self._base_z, self._view.follow)
            self._robot.repaint(self._view)
            self._scan.repaint(self._frame, self._view)
            self._map.repaint(self._frame, self._selected, self._ring, self._view)
            self._gathered.repaint(self._view.layers["gathered"])
            self._show_more(self._frame)

    # --- what people do; each runs in viser's thread and crosses over ---------------------------

    def _cross(self, function: Callable[..., None], *arguments: Any) -> None:  # noqa: ANN401
        with contextlib.suppress(RuntimeError):  # the loop has ended before viser's thread
            self._loop.call_soon_threadsafe(function, *arguments)

    def _on_change(self, name: str, value: Value, client: viser.ClientHandle) -> None:
        self._cross(self._tuning.change, name, value, client)

    def _on_preset(self, name: str, client: viser.ClientHandle) -> None:
        self._cross(lambda: self._tuning.ask(self._commands.use_preset(name), client))

    def _on_reset(self, names: list[str], client: viser.ClientHandle) -> None:
        self._cross(lambda: self._tuning.ask(self._commands.reset_parameters(names), client))

    def _on_tree(self, number: int) -> None:
        self._tuning.ask(self._commands.select_tree(None if number == self._selected else number), None)

    def _on_cluster(self, instance: int | None, origin: Vector, direction: Vector) -> None:
        if self._frame is None:
            return
        shift = self._follower.shift
        cluster = self._scan.meant(instance, np.array(origin) - shift, np.array(direction))
        if cluster is not None:
            self._tuning.ask(self._commands.select_cluster(self._frame.index, cluster), None)

    def _on_follow(self) -> None:
        self._tuning.ask(self._commands.choose_view("follow", not self._view.follow), None)

    def _on_camera(self, name: str, client: viser.ClientHandle) -> None:
        self._cross(self._aim, name, client)

    def _aim(self, name: str, client: viser.ClientHandle) -> None:
        self._follower.look(client, self._pose, self._base_z, from_above=name == "top")

    def _put_back(self) -> None:
        self.show_parameters(self._parameters, self._preset)
