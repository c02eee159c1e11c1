// A robot on two wheels that speaks neurosim's lines (docs/lines.md): a TB6612 or L298N motor
// driver, wheel encoders on two interrupt pins, two light sensors that look down. Change the part
// above the line for your robot; on an ESP32 the port may be a BluetoothSerial or a WiFiClient.
#include "lines.h"

const int LEFT_PWM = 5, LEFT_FORWARD = 7, LEFT_BACK = 8;
const int RIGHT_PWM = 6, RIGHT_FORWARD = 9, RIGHT_BACK = 10;
const int LEFT_ENCODER = 2, RIGHT_ENCODER = 3, LED = 13;
const int LEFT_LIGHT = A0, RIGHT_LIGHT = A1;

const char *const ROBOT = "two-wheels arduino-1.0";
const Number COMMANDS[] = {{"left", "%", -100, 100, "speed"}, {"right", "%", -100, 100, "speed"}};
const uint8_t COMMANDS_COUNT = 2;
const char *const ABOUT[] = {
    "body wheels full=0.4 track=0.13 radius=0.1",  // m/s at 100 %, m between the wheels, m
    "sensor line_left 1023 x=0.06 y=0.03",         // m ahead of the axle and to the left
    "sensor line_right 1023 x=0.06 y=-0.03",
    "counter left 1000",                           // pulses per metre
    "counter right 1000",
    "lamp",
    nullptr,
};

// ------------------------------------------------------------------------------------------------

volatile long counts[2] = {0, 0};
volatile int8_t direction[2] = {1, 1};

void countLeft() { counts[0] += direction[0]; }
void countRight() { counts[1] += direction[1]; }

void wheel(int side, int pwm, int forward, int back, float percent) {
  if (percent != 0) direction[side] = percent > 0 ? 1 : -1;  // kept while the motor coasts
  digitalWrite(forward, percent > 0);
  digitalWrite(back, percent < 0);
  analogWrite(pwm, (int)(fabs(percent) * 2.55f + 0.5f));
}

void move(const float *command) {
  wheel(0, LEFT_PWM, LEFT_FORWARD, LEFT_BACK, command[0]);
  wheel(1, RIGHT_PWM, RIGHT_FORWARD, RIGHT_BACK, command[1]);
}

void halt() {
  const float none[2] = {0, 0};
  move(none);
}

void values(Print &out) {
  const int lights[2] = {analogRead(LEFT_LIGHT), analogRead(RIGHT_LIGHT)};
  noInterrupts();
  const long counted[2] = {counts[0], counts[1]};
  interrupts();
  for (int value : lights) {
    out.print(' ');
    out.print(value);
  }
  for (long value : counted) {
    out.print(' ');
    out.print(value);
  }
}

bool lamp(bool on) {
  digitalWrite(LED, on);
  return true;
}

Lines lines(Serial);

void setup() {
  const int outputs[] = {LEFT_PWM, LEFT_FORWARD, LEFT_BACK, RIGHT_PWM, RIGHT_FORWARD, RIGHT_BACK, LED};
  for (int pin : outputs) pinMode(pin, OUTPUT);
  pinMode(LEFT_ENCODER, INPUT_PULLUP);
  pinMode(RIGHT_ENCODER, INPUT_PULLUP);
  attachInterrupt(digitalPinToInterrupt(LEFT_ENCODER), countLeft, RISING);
  attachInterrupt(digitalPinToInterrupt(RIGHT_ENCODER), countRight, RISING);
  Serial.begin(115200);
  lines.begin();
}

void loop() { lines.poll(); }
