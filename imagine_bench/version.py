"""The version of this package, and where it is installed."""

from pathlib import Path

__version__ = "0.2.0.dev0"
PACKAGE_FOLDER = Path(__file__).parent
"""The folder ``imagine_bench``; in a checkout its parent is the top folder."""
