from cli_pipeline import pipeline

__all__ = ["pipeline"]
