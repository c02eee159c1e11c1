"""A robot on two wheels with a micro:bit, over its USB: copy it as main.py, and lines.py with it.

A motor driver with a speed and a direction pin for each wheel, two light sensors that look down,
no encoders. Change the pins and the measures to your robot's.
"""

from lines import Lines
from microbit import display, pin0, pin1, pin2, pin8, pin12, pin16, running_time, sleep, uart


class Robot:
    name = "two-wheels micropython-1.0"
    commands = [("left", "%", -100, 100, "speed"), ("right", "%", -100, 100, "speed")]
    about = [
        "body wheels full=0.25 track=0.1 radius=0.08",  # m/s at 100 %, m between the wheels, m
        "sensor line_left 1023 x=0.05 y=0.02",  # m ahead of the axle and to the left
        "sensor line_right 1023 x=0.05 y=-0.02",
        "lamp",
    ]

    def move(self, command):
        for percent, speed, back in zip(command, (pin8, pin16), (pin12, pin0)):
            back.write_digital(1 if percent < 0 else 0)
            speed.write_analog(int(abs(percent) * 10.23))

    def halt(self):
        self.move([0, 0])

    def values(self):
        return [pin1.read_analog(), pin2.read_analog()]

    def lamp(self, on):
        for place in range(25):
            display.set_pixel(place % 5, place // 5, 9 if on else 0)
        return True


def run():
    uart.init(baudrate=115200)
    lines = Lines(Robot(), uart.write, running_time)
    while True:
        lines.poll(uart.read() if uart.any() else b"")
        sleep(1)


run()
