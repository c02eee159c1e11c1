"""Runs a program of firmware/micropython on a computer: micropython run.py FOLDER NAME.

Its board's modules are made up here: two motors turn as their pins say and press the encoders.
"""

import select as REAL
import sys
import time

if sys.implementation.name == "micropython":
    ticks = time.ticks_ms
else:  # Python itself, where MicroPython's unix port is not available

    def ticks():
        return int(1000 * time.monotonic())

    class Input:
        buffer = open(0, "rb", buffering=0)

        def fileno(self):
            return 0

    class Output:
        buffer = open(1, "wb", buffering=0)

    time.ticks_ms = ticks
    sys.stdin, sys.stdout = Input(), Output()

PULSES = 400  # a second at full power


class Module:
    def __init__(self, **members):
        for name, value in members.items():
            setattr(self, name, value)


class Pin:
    OUT = IN = PULL_UP = IRQ_RISING = 1
    pressed = []

    def __init__(self, number, mode=0, pull=0):
        self.state = 0

    def value(self, state):
        self.state = state

    def irq(self, handler, trigger):
        Pin.pressed.append(handler)


class PWM:
    every = []

    def __init__(self, pin):
        self.duty, self.turned = 0, 0.0
        PWM.every.append(self)

    def freq(self, hertz):
        pass

    def duty_u16(self, duty):
        assert 0 <= duty <= 65535
        self.duty = duty


class ADC:
    def __init__(self, pin):
        pass

    def read_u16(self):
        return 30000


class Poll:
    """Waits for input; the motors turn meanwhile."""

    def __init__(self):
        self.real, self.last = REAL.poll(), ticks()

    def register(self, stream, events):
        self.real.register(stream, events)

    def poll(self, milliseconds):
        now = ticks()
        for motor in Motor.every:
            motor.turned += motor.speed * (now - self.last) / 1000
        for pwm, press in zip(PWM.every, Pin.pressed):
            pwm.turned += PULSES * pwm.duty / 65535 * (now - self.last) / 1000
            while pwm.turned >= 1:
                pwm.turned -= 1
                press(None)
        self.last = now
        result = self.real.poll(milliseconds)
        if result and result[0][1] & 16:  # hung up
            sys.exit()
        return result


class Motor:
    every = []

    def __init__(self, port, direction=None):
        self.speed, self.turned = 0, 0.0
        Motor.every.append(self)

    def run(self, speed):
        assert -1000 <= speed <= 1000
        self.speed = speed

    def brake(self):
        self.speed = 0

    def angle(self):
        return int(self.turned)


class ThisHub:
    def __init__(self):
        self.battery = Module(voltage=lambda: 7900)
        self.light = Module(on=lambda colour: None, off=lambda: None)


class StopWatch:
    def __init__(self):
        self.zero = ticks()

    def time(self):
        return ticks() - self.zero


class MicrobitPin:
    def write_digital(self, value):
        assert value in (0, 1)

    def write_analog(self, value):
        assert 0 <= value <= 1023

    def read_analog(self):
        return 500


class Uart:
    def __init__(self):
        self.waiting = Poll()
        self.waiting.register(sys.stdin, 1)

    def init(self, baudrate):
        pass

    def any(self):
        return bool(self.waiting.poll(1))

    def read(self):
        return sys.stdin.buffer.read(1)

    def write(self, data):
        sys.stdout.buffer.write(data)


class Display:
    def set_pixel(self, x, y, value):
        assert 0 <= x < 5
        assert 0 <= y < 5
        assert 0 <= value <= 9


folder, name = sys.argv[1], sys.argv[2]
sys.path.insert(0, folder)
if name == "main_microbit":
    pins = {"pin%d" % number: MicrobitPin() for number in (0, 1, 2, 8, 12, 16)}
    sys.modules["microbit"] = Module(
        display=Display(), running_time=ticks, sleep=lambda ms: None, uart=Uart(), **pins
    )
elif name == "main_pybricks":
    parts = {
        "hubs": Module(ThisHub=ThisHub),
        "parameters": Module(
            Color=Module(WHITE=0), Direction=Module(COUNTERCLOCKWISE=1), Port=Module(A=0, B=1)
        ),
        "pupdevices": Module(Motor=Motor),
        "tools": Module(StopWatch=StopWatch),
    }
    sys.modules["pybricks"] = Module(**parts)
    for part, module in parts.items():
        sys.modules["pybricks." + part] = module
    sys.modules["usys"] = Module(stdin=sys.stdin, stdout=sys.stdout)
    sys.modules["uselect"] = Module(POLLIN=1, poll=Poll)
else:
    sys.modules["machine"] = Module(ADC=ADC, PWM=PWM, Pin=Pin)
    sys.modules["select"] = Module(POLLIN=1, poll=Poll)
__import__(name)
