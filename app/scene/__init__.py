"""The 3D scene with its sliders. Nothing outside of this package knows viser."""

from app.scene.scene import Scene
from app.scene.server import SECRET_HEADER
from app.scene.tuning import SceneCommands

__all__ = ["SECRET_HEADER", "Scene", "SceneCommands"]
