"""A robot on two wheels with a Raspberry Pi Pico or an ESP32, over its USB: copy it as main.py.

A TB6612 or L298N motor driver, an encoder on each wheel, two light sensors that look down. Change
the pins and the measures to your robot's.
"""

import sys
import time
from select import POLLIN, poll

from lines import Lines
from machine import ADC, PWM, Pin


class Wheel:
    def __init__(self, pwm, forward, back, encoder):
        self.pwm, self.forward, self.back = PWM(Pin(pwm)), Pin(forward, Pin.OUT), Pin(back, Pin.OUT)
        self.pwm.freq(1000)
        self.count, self.direction = 0, 1
        self.encoder = Pin(encoder, Pin.IN, Pin.PULL_UP)
        self.encoder.irq(self.pressed, Pin.IRQ_RISING)

    def pressed(self, pin):
        self.count += self.direction

    def turn(self, percent):
        if percent:
            self.direction = 1 if percent > 0 else -1  # kept while the motor coasts
        self.forward.value(percent > 0)
        self.back.value(percent < 0)
        self.pwm.duty_u16(int(abs(percent) * 655.35))


class Robot:
    name = "two-wheels micropython-1.0"
    commands = [("left", "%", -100, 100, "speed"), ("right", "%", -100, 100, "speed")]
    about = [
        "body wheels full=0.4 track=0.13 radius=0.1",  # m/s at 100 %, m between the wheels, m
        "sensor line_left 65535 x=0.06 y=0.03",  # m ahead of the axle and to the left
        "sensor line_right 65535 x=0.06 y=-0.03",
        "counter left 1000",  # pulses per metre
        "counter right 1000",
        "lamp",
    ]

    def __init__(self):
        self.wheels = [Wheel(2, 3, 4, 5), Wheel(6, 7, 8, 9)]
        self.lights = [ADC(Pin(26)), ADC(Pin(27))]
        self.led = Pin(25, Pin.OUT)

    def move(self, command):
        for wheel, percent in zip(self.wheels, command):
            wheel.turn(percent)

    def halt(self):
        self.move([0, 0])

    def values(self):
        return [light.read_u16() for light in self.lights] + [one.count for one in self.wheels]

    def lamp(self, on):
        self.led.value(on)
        return True


def run():
    lines = Lines(Robot(), sys.stdout.buffer.write, time.ticks_ms)
    waiting = poll()
    waiting.register(sys.stdin, POLLIN)
    while True:
        lines.poll(sys.stdin.buffer.read(1) if waiting.poll(1) else b"")


run()
