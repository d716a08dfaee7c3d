"""How Chromium is started: without a screen, without calling home, and with a scene drawn by software."""

from __future__ import annotations

FLAGS = [
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    # The page itself is drawn without a graphics card's means: a third of the work.
    "--disable-gpu-compositing",
]
