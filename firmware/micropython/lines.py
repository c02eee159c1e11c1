"""The text-line protocol of neurosim, docs/lines.md, version 1, for MicroPython (and Python).

Change nothing here for another robot: main.py describes the robot and moves it.
"""

LONGEST = 60000  # of a command, ms
ROOM = 96  # of a line


def checksum(data):
    """CRC-16/CCITT-FALSE."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = ((crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


class Lines:
    """Takes bytes, moves a robot, writes bytes.

    ``robot`` has ``name`` (a name and a version, one word each), ``commands`` (tuples of name,
    unit, low, high, and speed or angle), ``about`` (other lines of the greeting), and
    ``move(command)``, ``halt()``, ``values()``, ``lamp(on)``. ``write`` takes bytes, ``ticks``
    gives milliseconds.
    """

    def __init__(self, robot, write, ticks):
        self.robot, self.write, self.ticks = robot, write, ticks
        self.line = bytearray()
        self.last, self.now, self.ends = ticks(), 0, None
        robot.halt()
        self.say("0", "robot neurosim-lines 1 " + robot.name)

    def poll(self, data):
        """Read received bytes, or None; call it all the time, because it also ends commands."""
        self.expire()
        for byte in data or b"":
            if byte in b"\r\n":
                line, self.line = self.line, bytearray()
                if len(line) > ROOM:
                    self.say("0", "error too long")
                elif line:
                    self.carry_out(line)
            elif len(self.line) <= ROOM:
                self.line.append(byte if byte < 128 else 63)
            self.expire()

    def expire(self):
        """Keep the time, and end the command that is over."""
        ticks = self.ticks()
        self.now += (ticks - self.last) & 0x3FFFFFFF  # they may begin again at 0
        self.last = ticks
        if self.ends is not None and self.now >= self.ends:
            self.stop()

    def stop(self):
        self.ends = None
        self.robot.halt()

    def say(self, number, text):
        data = (number + " " + text).encode()
        self.write(data + b"*%04X\n" % checksum(data))

    def carry_out(self, line):
        text, star, digits = line.decode().partition("*")
        if star and digits.upper() != "%04X" % checksum(text.encode()):
            return self.say("0", "error checksum")
        words = text.split()
        number = words.pop(0) if words and words[0].isdigit() else "0"
        request, rest = (words[0], words[1:]) if words else ("", [])
        answer = "ok %d" % (self.now & 0xFFFFFFFF)
        if request == "hello":
            self.stop()
            answer += " %d" % self.greet(number)
        elif request == "stop":
            self.stop()
        elif request == "read":
            left = 0 if self.ends is None else self.ends - self.now
            values = [self.now & 0xFFFFFFFF, left] + list(self.robot.values())
            answer = " ".join(["read"] + [str(value) for value in values])
        elif not star:
            answer = "error checksum"  # requests that move the robot need one
        elif request == "drive":
            answer = answer if self.drive(rest) else "error numbers"
        elif request != "lamp" or rest not in (["0"], ["1"]) or not self.robot.lamp(rest == ["1"]):
            answer = "error request"
        self.say(number, answer)

    def drive(self, words):
        try:
            duration, command = int(words[0]), [float(word) for word in words[1:]]
        except (ValueError, IndexError):
            return False
        limits = self.robot.commands
        good = 1 <= duration <= LONGEST and len(command) == len(limits)
        if not good or not all(one[2] <= v <= one[3] for v, one in zip(command, limits)):
            return False
        self.ends = self.now + duration
        self.robot.move(command)
        return True

    def greet(self, number):
        lines = ["robot neurosim-lines 1 " + self.robot.name, "longest %d" % LONGEST]
        lines += ["command %s %s %g %g %s" % one for one in self.robot.commands]
        lines += self.robot.about
        for line in lines:
            self.say(number, line)
        return len(lines)
