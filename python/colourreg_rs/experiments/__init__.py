"""The experiments of the paper that this package began with, made again on simulated scenes whose truth is known.

Source: Lim, Bae and Belton, Semi-Automated Colour Registration and Evaluation of Digital Photogrammetry and Terrestrial
Laser Scanning.
"""

from .reproduce import Reproduction, reproduce

__all__ = ["Reproduction", "reproduce"]
