"""The accuracy of a registration as one HTML file: offline, for desk, phone and paper."""

from .page import write_report

__all__ = ["write_report"]
