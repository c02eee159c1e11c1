"""A robot on two wheels with a LEGO hub that runs Pybricks: SPIKE Prime, Essential, Robot Inventor.

Motors on ports A (left) and B (right), turned round to each other, with wheels of 56 mm. Change the
ports and the measures to your robot's. Open this file and lines.py in Pybricks Code, and download.
"""

from lines import Lines
from pybricks.hubs import ThisHub
from pybricks.parameters import Color, Direction, Port
from pybricks.pupdevices import Motor
from pybricks.tools import StopWatch
from uselect import POLLIN, poll
from usys import stdin, stdout

FULL = 800  # degrees a second at 100 %


class Robot:
    name = "two-wheels pybricks-1.0"
    commands = [("left", "%", -100, 100, "speed"), ("right", "%", -100, 100, "speed")]
    about = [
        "body wheels full=0.391 track=0.112 radius=0.1",  # m/s at 100 %, m between the wheels, m
        "counter left 2046.3",  # pulses (degrees) per metre
        "counter right 2046.3",
        "lamp",
        "battery",
    ]

    def __init__(self):
        self.hub = ThisHub()
        self.wheels = [Motor(Port.A, Direction.COUNTERCLOCKWISE), Motor(Port.B)]

    def move(self, command):
        for wheel, percent in zip(self.wheels, command):
            wheel.run(percent * FULL / 100)

    def halt(self):
        for wheel in self.wheels:
            wheel.brake()

    def values(self):
        return [wheel.angle() for wheel in self.wheels] + [self.hub.battery.voltage()]

    def lamp(self, on):
        if on:
            self.hub.light.on(Color.WHITE)
        else:
            self.hub.light.off()
        return True


def run():
    lines = Lines(Robot(), stdout.buffer.write, StopWatch().time)
    waiting = poll()
    waiting.register(stdin, POLLIN)
    while True:
        lines.poll(stdin.buffer.read(1) if waiting.poll(1) else b"")


run()
