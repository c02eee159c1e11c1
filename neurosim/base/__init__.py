"""The base layer: errors for users, files written whole, planar poses, progress.

It imports nothing of the project; every other package (``tracking`` included) may import it.
"""
