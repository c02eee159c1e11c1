"""A virtual Thymio II: its firmware, its body, and the line to it."""
