"""neurosim: a robot builds its own simulator."""

__version__ = "0.1.0"
