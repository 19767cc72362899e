"""Simulated scans and photos with their truth: scenes that look real, ray-cast exactly, errors put in by hand."""

from __future__ import annotations

from .disturbance import Disturbance
from .options import simulate_from_text
from .photo import Response, SimulatedPhoto
from .scanner import Scanner, ScanTruth
from .scene import Frame, Hits, Scene
from .scenes import SCENES
from .simulation import Simulation, simulate
from .write import write_simulation

__all__ = [
    "SCENES",
    "Disturbance",
    "Frame",
    "Hits",
    "Response",
    "ScanTruth",
    "Scanner",
    "Scene",
    "SimulatedPhoto",
    "Simulation",
    "simulate",
    "simulate_from_text",
    "write_simulation",
]
