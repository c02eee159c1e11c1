"""A camera that delivers its pictures late."""

from collections import deque


def delay(camera, frames):
    """Make a camera of the lab deliver its pictures some frames late."""
    start, waiting = camera.start, deque()

    def delayed(take):
        def put(time, frame):
            waiting.append((time, frame.copy()))
            if len(waiting) > frames:
                take(*waiting.popleft())

        start(put)

    camera.start = delayed
