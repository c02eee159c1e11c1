"""Coloured markers in overhead video: camera model, tracker, clock, recordings, datasets."""
