"""A body and a clock that only remember their calls, for tests of the virtual brick."""

import threading

from neurosim.lab.nxt.body import Output


class Body:
    """Remembers its commands; every sensor port gives the same raw value."""

    def __init__(self, raw=460, millivolts=7900):
        self.outputs = [Output() for _ in range(3)]
        self.types = [(0, 0)] * 4
        self.raw, self.millivolts = raw, millivolts
        self.resets = []

    def set_output(self, port, power, mode, regulation, turn_ratio, run_state, tacho_limit):
        counts = self.outputs[port]
        self.outputs[port] = Output(
            power, mode, regulation, turn_ratio, run_state, tacho_limit, counts.tacho_count
        )

    def output(self, port):
        return self.outputs[port]

    def reset_tacho(self, port, relative):
        self.resets.append((port, relative))

    def set_input(self, port, type, mode):
        self.types[port] = (type, mode)

    def input(self, port):
        return (True, self.raw, *self.types[port])

    def battery_millivolts(self):
        return self.millivolts


class LabClock:
    """Stands still until it is asked to advance."""

    def __init__(self):
        self.time = 0.0
        self._lock = threading.Lock()

    def now(self):
        return self.time

    def sleep_until(self, time):
        with self._lock:
            self.time = max(self.time, time)
