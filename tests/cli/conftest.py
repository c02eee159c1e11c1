from cli_road import road

__all__ = ["road"]
