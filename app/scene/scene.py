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

from app.scene.colours import COLOUR_BY, ViewSettings
from app.scene.map import Accumulated, ErrorNode, MapCloud, MapNodes, Ring, TreeFeet
from app.scene.panel import PanelCommands, SceneCommands, TunePanel
from app.scene.robot import RobotNodes, WayNode
from app.scene.scan import ScanNodes, Vector, VoxelNode, extent
from app.scene.viser_server import add_posed, messages_sent, silenced, start_server
from pipeline.config import Parameters, preset
from pipeline.geometry.poses import Pose2
from pipeline.types.records import Frame, TruthTrees

Float = NDArray[np.float64]

# A browser that connects later steps through all message numbers: 50 million took 17 s.
RENEW_AFTER = 2_000_000


class Scene:
    """Shows frames in viser and passes the actions of people there to the server. The constructor starts
    viser.

    All methods are called on `loop`. Callbacks of the thread of viser are passed to `loop` first, so that
    only one thread changes the nodes.

    Args:
        commands: Commands of the scene to the server.
        loop: Event loop of the server.

    Attributes:
        secret: Value of the header `X-Stemmap-Secret` that viser requires.
    """

    def __init__(self, commands: SceneCommands, loop: asyncio.AbstractEventLoop) -> None:
        self.secret = secrets.token_urlsafe(32)
        self._commands, self._loop = commands, loop
        self._view = ViewSettings()
        self._tuning = PanelCommands(commands, self._put_back)
        self._parameters, self._preset = preset("forest"), "forest"
        self._frame: Frame | None = None
        self._reflectance: NDArray[np.uint8] | None = None
        self._path: Float = np.zeros((0, 4))
        self._truth: TruthTrees | None = None
        self._selected: int | None = None
        self._ring: Ring = None
        self._accumulated, self._feet = Accumulated(), TreeFeet()
        self._build()

    @property
    def port(self) -> int:
        """Port of viser on 127.0.0.1. It changes when viser is restarted, so it must be read each time."""
        return self._server.get_port()

    @property
    def messages(self) -> int:
        """Number of messages that viser has numbered since it was started."""
        return messages_sent(self._server)

    def show(self, frame: Frame, path: Float, reflectance: NDArray[np.uint8] | None = None) -> None:
        """Show the results of a scan. The first one sets the distance of the cameras to the extent of a whole
        cloud. After RENEW_AFTER messages viser is restarted first, and `port` changes.

        Args:
            frame: Results of the scan.
            path: Positions of the robot at all scans: x, y in the frame of the map and x, y by odometry, NaN
                where unknown, shape (N, 4) [m].
            reflectance: Of the raw points, uint8, shape (M,); None if unknown.
        """
        first = self._frame is None
        self._frame, self._path, self._reflectance = frame, path, reflectance
        if first:
            self._follower.frame_plot(0.0 if frame.of_drive else extent(frame))
        self._accumulated.take(frame)
        if self.messages > RENEW_AFTER:
            self._renew()
        else:
            self._draw()

    def show_parameters(self, parameters: Parameters, preset_name: str) -> None:
        """Set the widgets to parameters, without a callback; sliders that a person is moving are not set. The
        parameters also apply to voxels, errors and the path ahead when a scan is rendered next.

        Args:
            parameters: The values.
            preset_name: Name of the preset of the parameters.
        """
        self._parameters, self._preset = parameters, preset_name
        with self._server.atomic():
            self._tune.show(parameters, preset_name, self._tuning.moving)

    def show_truth(self, trees: TruthTrees | None) -> None:
        """Show the ground truth; None removes it."""
        self._truth = trees
        with self._server.atomic():
            self._map.show_truth(trees, self._view)

    def select(self, tree: int | None, ring: Ring = None) -> Vector | None:
        """Highlight the selection in place of the one before; if no scan is shown, with the next scan.

        Args:
            tree: Number of the selected tree, or None; an unknown number highlights nothing.
            ring: x, y and radius of the selected cluster [m] in the frame of the map, or None.

        Returns:
            x, y and height of the ground [m] in the map of the selected cluster, else of the selected tree;
            None before the first scan, without a selection, and if the tree is no confirmed tree of the shown
            scan.
        """
        self._selected, self._ring = tree, ring
        self._draw()
        return None if self._frame is None else self._map.place_of(self._frame, tree, ring)

    def suit(self, *, drive: bool) -> None:
        """Choose how points are coloured when a run begins: the scans of a drive by verdict, else by height.
        Other choices of a person stay. The sliders are hidden without a drive, whose parameters they are.
        The shown scan is not drawn again."""
        self._tune.suit(drive=drive)
        usual = COLOUR_BY[0]
        if self._view.colour_by in (usual, "height"):
            self._view.colour_by = usual if drive else "height"

    @property
    def view(self) -> dict[str, Any]:
        """State of the view for the dashboard, a dict with the keys of `ViewSettings.as_plain` and
        `counts`."""
        return {**self._view.as_plain(), "counts": self.counts}

    @property
    def counts(self) -> dict[str, int]:
        """Dict from layers to the number of their elements: `ground` (triangles), `voxels`, `gathered`
        (points) and `errors` (missed and false trees)."""
        return {
            "ground": self._map.ground.faces,
            "voxels": self._voxels.count,
            "gathered": len(self._accumulated.points_of(self._view.accumulated)),
            "errors": self._errors.count,
        }

    def choose(self, name: str, value: str | bool) -> None:
        """Set one choice of the view, see `ViewSettings.choose`, and draw the shown scan accordingly.

        Raises:
            ParameterError: There is no such choice, or the value is not one of it; nothing changes.
        """
        self._view.choose(name, value)
        self._draw()

    def clear(self) -> None:
        """Remove run, ground truth and selection from the scene. The panel and the choices of the view
        stay; the cameras return to the size of a robot."""
        self._frame, self._path, self._reflectance = None, np.zeros((0, 4)), None
        self._truth = self._selected = self._ring = None
        self._accumulated, self._feet = Accumulated(), TreeFeet()
        self._follower.frame_plot(0.0)  # the new one does not know where the cameras are
        with self._server.atomic():
            self._server.scene.reset()
            self._add_nodes()

    def close(self) -> None:
        """Cancel commands in progress and stop viser."""
        self._tuning.stop()
        with silenced():
            self._server.stop()

    # --- building ------------------------------------------------------------------------------

    def _build(self) -> None:
        """Start viser with the panel, the keys and empty nodes."""
        self._server = start_server(self.secret)
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(0, 114, 178))
        gui.main_panel.dock_right()
        gui.main_panel.set_width(330)
        self._tune = TunePanel(gui, self._parameters, self._preset, self._tuning, self._call_on_loop)
        add_hotkeys(gui, self._on_camera, functools.partial(self._call_on_loop, self._on_follow))
        self._add_nodes()

    def _add_nodes(self) -> None:
        """Add the nodes of all layers, without content."""
        scene = self._server.scene
        scene.set_up_direction("+z")
        scene.configure_default_lights(enabled=True, cast_shadow=False)
        self._follower = Follower(self._server)
        self._grid = scene.add_grid(
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
        self._scan = ScanNodes(scene, functools.partial(self._call_on_loop, self._on_cluster))
        self._map = MapNodes(scene, functools.partial(self._call_on_loop, self._on_tree))
        self._voxels = VoxelNode(scene)
        self._gathered = MapCloud(scene)
        self._errors = ErrorNode(scene)
        self._way = WayNode(scene)

    def _renew(self) -> None:
        """Start another viser with the same content and stop the old one."""
        old = self._server
        # Browsers lose their connection when the old server stops, and reconnect to the new one by the proxy.
        self._build()
        self.show_truth(self._truth)
        self._draw()
        with silenced():
            old.stop()

    # --- showing -------------------------------------------------------------------------------

    @property
    def _pose(self) -> Pose2:
        """Pose of the robot in the map; the identity before the first scan."""
        return Pose2() if self._frame is None else self._frame.estimate.T_map_base

    @property
    def _base_z(self) -> float:
        """Height of the robot [m]; 0 before the first scan."""
        return 0.0 if self._frame is None else self._frame.base_z

    def _draw(self) -> None:
        """Draw the newest scan with the choices of the view in one group of messages; nothing without one.
        Each node sends only what changed."""
        frame, layers = self._frame, self._view.layers
        if frame is None:
            return
        parameters = self._parameters
        with self._server.atomic():  # otherwise the points would move before the robot
            self._grid.visible = frame.of_drive  # its zero is far below or above the plot
            self._follower.show(self._pose, self._base_z, self._view.follow)
            # First, because the other nodes use the heights of its ground.
            self._map.show(frame, self._selected, self._ring, self._view, self._feet)
            self._map.show_truth(self._truth, self._view)
            self._robot.show(frame, self._path, self._view, self._map.ground)
            self._scan.show(frame, self._view, self._map.labelled, self._reflectance)
            self._gathered.show(layers["gathered"], self._accumulated.points_of(self._view.accumulated))
            self._voxels.show(layers["voxels"], frame, parameters.filters.voxel_size)
            self._way.show_ahead(layers["way"], frame, parameters.obstacles)
            self._errors.show_errors(
                layers["errors"],
                frame,
                self._truth,
                self._path[:, :2],
                parameters.evaluation,
                self._map.ground,
            )

    # --- callbacks in the thread of viser, passed to the loop -------------------------------------

    def _call_on_loop(self, function: Callable[..., None], *arguments: Any) -> None:  # noqa: ANN401
        """Call a function on the loop of the server, from any thread; nothing if the loop has ended."""
        with contextlib.suppress(RuntimeError):  # the loop has ended before viser's thread
            self._loop.call_soon_threadsafe(function, *arguments)

    def _on_tree(self, number: int) -> None:
        """Select a tree, or clear the selection if it is selected already."""
        self._tuning.ask(self._commands.select_tree(None if number == self._selected else number), None)

    def _on_cluster(self, instance: int | None, origin: Vector, direction: Vector) -> None:
        """Select the cluster that a click hit; nothing if none is near.

        Args:
            instance: Number of the hit marker; None if unknown.
            origin, direction: Ray of the click in the world of viser.
        """
        if self._frame is None:
            return
        shift = self._follower.shift
        cluster = self._scan.meant(instance, np.array(origin) - shift, np.array(direction))
        if cluster is not None:
            self._tuning.ask(self._commands.select_cluster(self._frame.index, cluster), None)

    def _on_follow(self) -> None:
        self._tuning.ask(self._commands.choose_view("follow", not self._view.follow), None)

    def _on_camera(self, name: str, client: viser.ClientHandle) -> None:
        self._call_on_loop(self._aim, name, client)

    def _aim(self, name: str, client: viser.ClientHandle) -> None:
        """Turn the camera of one browser to the robot: from above for "top", else from behind."""
        self._follower.look(client, self._pose, self._base_z, from_above=name == "top")

    def _put_back(self) -> None:
        """Reset the widgets to the present values."""
        self.show_parameters(self._parameters, self._preset)


WORLD = "/world"  # parent of all nodes; its children are in the frame of the map
# Positions of a camera relative to the robot [m].
BEHIND = (-13.0, -7.5, 9.5)
ABOVE = (0.0, -0.01, 52.0)
FIELD_OF_VIEW = np.deg2rad(45.0)  # vertical [rad]; viser's 75 degrees draws stems at the border askew
SEEN = 12.0  # width of the area that these cameras show [m]


class Follower:
    """Keeps the robot at the origin of the viewer by moving the world instead of the cameras.

    The pose of a camera arrives from the browser some frames late, so that moving the camera from here would
    interfere with the person who turns it. The pose of the world is sent in one group with the points. When
    following ends, the world keeps its pose.

    Args:
        server: Server of viser, to which the frame of the world is added.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._world = add_posed(server.scene, WORLD)
        self._server = server
        self._scale = 1.0
        self._set_initial_camera()

    def frame_plot(self, extent: float) -> None:
        """Move all cameras so that they show a plot, or the surroundings of a robot. Nothing if the scale of
        the view does not change.

        Args:
            extent: Width of the plot [m]; 0 for a robot.
        """
        scale = max(extent / SEEN, 1.0)
        if scale == self._scale:
            return
        self._scale = scale
        self._set_initial_camera()
        for client in self._server.get_clients().values():
            self.look(client, Pose2(), 0.0, from_above=False, origin=True)

    def _set_initial_camera(self) -> None:
        """Set the camera of browsers that connect later."""
        self._server.initial_camera.position = tuple(self._scale * np.array(BEHIND))
        self._server.initial_camera.look_at = (0.0, 0.0, 0.5)
        self._server.initial_camera.fov = FIELD_OF_VIEW

    def show(self, pose: Pose2, z: float, follow: bool) -> None:
        """Move the world so that the robot is at the origin, if following is on.

        Args:
            pose: Pose of the robot in the map.
            z: Height of the robot [m].
            follow: Whether following is on; otherwise nothing moves.
        """
        if follow:
            self._world.position = (-pose.x, -pose.y, -z)

    @property
    def shift(self) -> NDArray[np.float64]:
        """Position of the origin of the map in the world of viser, shape (3,) [m]."""
        return np.array(self._world.position, dtype=np.float64)

    def look(
        self, client: viser.ClientHandle, pose: Pose2, z: float, *, from_above: bool, origin: bool = False
    ) -> None:
        """Move the camera of one browser to a fixed offset from the robot, scaled by `frame_plot`, and point
        it at the robot. The offset is along the axes of the viewer; the heading does not matter.

        Args:
            client: The browser.
            pose: Pose of the robot in the map; only x, y are used.
            z: Height of the robot in the map [m].
            from_above: Whether the camera is above the robot (ABOVE); otherwise it is at BEHIND.
            origin: Whether the target is the origin of the viewer instead of the robot.
        """
        target = np.zeros(3) if origin else np.array([pose.x, pose.y, z]) + self._world.position
        with client.atomic():
            client.camera.up_direction = np.array([0.0, 0.0, 1.0])
            client.camera.position = target + self._scale * np.array(ABOVE if from_above else BEHIND)
            client.camera.look_at = target


OnCamera = Callable[[str, viser.ClientHandle], None]


def add_hotkeys(gui: viser.GuiApi, on_camera: OnCamera, on_follow: Callable[[], None]) -> None:
    """Add commands with keys. They work while the scene has the focus; otherwise the page forwards the keys.

    Args:
        gui: Panel of viser.
        on_camera: Called in the thread of viser with "top" or "behind" and the client.
        on_follow: Called in the thread of viser to start or stop following.
    """

    @gui.add_command("Top view", description="Look down on the robot", hotkey="T").on_trigger
    async def _(event: viser.CommandEvent) -> None:
        if event.client is not None:
            on_camera("top", event.client)

    @gui.add_command("Behind the robot", description="Look from behind", hotkey="B").on_trigger
    async def _(event: viser.CommandEvent) -> None:
        if event.client is not None:
            on_camera("behind", event.client)

    @gui.add_command("Follow the robot", description="Start or stop following", hotkey="F").on_trigger
    async def _(_event: viser.CommandEvent) -> None:
        on_follow()
