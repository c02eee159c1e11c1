// As much of Arduino as the sketch in firmware/ uses, for a process on a computer: the serial port
// is its input and output, and two motors turn under PWM pins and press the encoders' interrupts.
#pragma once
#include <cctype>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <initializer_list>

enum { LOW = 0, HIGH = 1, INPUT = 0, OUTPUT = 1, INPUT_PULLUP = 2, RISING = 3, A0 = 14, A1 = 15 };

uint32_t millis();
void pinMode(int pin, int mode);
void digitalWrite(int pin, int value);
void analogWrite(int pin, int value);
int analogRead(int pin);
inline int digitalPinToInterrupt(int pin) { return pin - 2; }
void attachInterrupt(int number, void (*function)(), int mode);
inline void noInterrupts() {}
inline void interrupts() {}

class Print {
 public:
  virtual size_t write(uint8_t byte) = 0;
  virtual size_t write(const uint8_t *bytes, size_t count);
  size_t print(const char *text);
  size_t print(char byte) { return write((uint8_t)byte); }
  size_t print(int value) { return print((long)value); }
  size_t print(unsigned value) { return print((unsigned long)value); }
  size_t print(long value);
  size_t print(unsigned long value);
  size_t print(double value, int digits = 2);
  virtual ~Print() {}
};

class Stream : public Print {
 public:
  virtual int available() = 0;
  virtual int read() = 0;
};

class HostSerial : public Stream {
 public:
  void begin(unsigned long) {}
  int available() override;
  int read() override;
  size_t write(uint8_t byte) override;
  using Print::write;
};
extern HostSerial Serial;
