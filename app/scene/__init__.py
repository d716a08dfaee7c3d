"""The 3D scene with its sliders. Only this package uses viser."""

from app.scene.scene import Scene
from app.scene.viser_server import SECRET_HEADER

__all__ = ["SECRET_HEADER", "Scene"]
