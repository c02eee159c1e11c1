// See Arduino.h. `host` runs the sketch in steps of a millisecond until its input is closed.
#include "Arduino.h"

#include <poll.h>
#include <time.h>
#include <unistd.h>

void setup();
void loop();

HostSerial Serial;

namespace {
constexpr int PWM[2] = {5, 6};
constexpr double PULSES = 400;  // a second at full power
int outputs[32];
void (*pressed[2])() = {nullptr, nullptr};
double turned[2] = {0, 0};

double seconds() {
  timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return now.tv_sec + 1e-9 * now.tv_nsec;
}
const double zero = seconds();

void turn(double passed) {
  for (int wheel = 0; wheel < 2; wheel++) {
    turned[wheel] += PULSES * outputs[PWM[wheel]] / 255.0 * passed;
    for (; turned[wheel] >= 1; turned[wheel] -= 1)
      if (pressed[wheel]) pressed[wheel]();
  }
}
}  // namespace

uint32_t millis() { return (uint32_t)(1000 * (seconds() - zero)); }
void pinMode(int, int) {}
void digitalWrite(int pin, int value) { outputs[pin] = value; }
void analogWrite(int pin, int value) { outputs[pin] = value; }
int analogRead(int pin) { return pin == A0 ? 500 : 510; }
void attachInterrupt(int number, void (*function)(), int) { pressed[number] = function; }

size_t Print::write(const uint8_t *bytes, size_t count) {
  for (size_t i = 0; i < count; i++) write(bytes[i]);
  return count;
}
size_t Print::print(const char *text) { return write((const uint8_t *)text, strlen(text)); }
size_t Print::print(long value) {
  char text[24];
  snprintf(text, sizeof text, "%ld", value);
  return print(text);
}
size_t Print::print(unsigned long value) {
  char text[24];
  snprintf(text, sizeof text, "%lu", value);
  return print(text);
}
size_t Print::print(double value, int digits) {
  char text[48];
  snprintf(text, sizeof text, "%.*f", digits, value);
  return print(text);
}

int HostSerial::available() {
  pollfd input = {STDIN_FILENO, POLLIN, 0};
  return poll(&input, 1, 0) > 0 && (input.revents & POLLIN);
}
int HostSerial::read() {
  uint8_t byte;
  if (::read(STDIN_FILENO, &byte, 1) != 1) exit(0);
  return byte;
}
size_t HostSerial::write(uint8_t byte) { return ::write(STDOUT_FILENO, &byte, 1) == 1; }

int main() {
  setup();
  for (double last = seconds();;) {
    pollfd input = {STDIN_FILENO, POLLIN, 0};
    poll(&input, 1, 1);
    if (input.revents & (POLLHUP | POLLERR) && !(input.revents & POLLIN)) return 0;
    loop();
    const double now = seconds();
    turn(now - last);
    last = now;
  }
}
