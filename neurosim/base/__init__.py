"""What every room stands on: errors for people, files that survive, planar poses, progress.

This is the cellar of the house: it imports nothing of the project, and every other room
(``tracking`` included) may import it.
"""
