// The text-line protocol of neurosim, docs/lines.md, version 1. Change nothing here for
// another robot: the sketch describes the robot and moves it.
#pragma once
#include <Arduino.h>
#include <errno.h>
#include <stdlib.h>
#include <string.h>

struct Number {  // one number of a command; kind: speed, or angle for what 0 does not stop
  const char *name, *unit;
  float low, high;
  const char *kind;
};

// The sketch has these.
extern const char *const ROBOT;            // a name and a version, one word each: "mini-car 1.0"
extern const char *const ABOUT[];          // other lines of the greeting, nullptr at the end
extern const Number COMMANDS[];            // the numbers of a command
extern const uint8_t COMMANDS_COUNT;
void move(const float *command);           // begin a command
void halt();                               // stop
void values(Print &out);                   // print " " and a whole number for each value of read
bool lamp(bool on);                        // false: the robot has no lamp

class Lines : public Print {
 public:
  explicit Lines(Stream &port) : port(port) {}

  void begin() {  // says that the robot has just started
    halt();
    print("0 robot neurosim-lines 1 ");
    print(ROBOT);
    end();
  }

  void poll() {  // call it from loop() all the time: it also ends commands
    expire();
    while (port.available()) {
      take(port.read());
      expire();
    }
  }

  size_t write(uint8_t byte) override {  // all output goes through here
    sum = added(sum, byte);
    return port.write(byte);
  }
  using Print::write;

 private:
  static constexpr uint32_t LONGEST = 60000;  // of a command, ms
  static constexpr uint8_t ROOM = 97, MOST = 8;

  Stream &port;
  char line[ROOM];
  uint8_t length = 0;
  uint16_t sum = 0xFFFF;
  uint32_t began = 0, lasts = 0;  // the command that runs; lasts is 0 if none does
  unsigned number = 0;            // of the request

  static uint16_t added(uint16_t sum, uint8_t byte) {  // CRC-16/CCITT-FALSE
    sum ^= (uint16_t)byte << 8;
    for (uint8_t bit = 0; bit < 8; bit++) sum = sum & 0x8000 ? (sum << 1) ^ 0x1021 : sum << 1;
    return sum;
  }

  void end() {  // ends a line with its checksum
    char digits[8];
    uint16_t found = sum;
    snprintf(digits, sizeof digits, "*%04X\n", found);
    for (const char *at = digits; *at; at++) port.write((uint8_t)*at);
    sum = 0xFFFF;
  }

  void say(const char *text) {
    print(number);
    print(' ');
    print(text);
  }

  void stop() {
    lasts = 0;
    halt();
  }

  void expire() {
    if (lasts && millis() - began >= lasts) stop();
  }

  void take(char byte) {
    if (byte != '\n' && byte != '\r') {
      if (length < ROOM) line[length++] = byte;
    } else {
      uint8_t had = length;
      length = 0;
      number = 0;
      if (had == ROOM) refuse("too long");
      else if (had) {
        line[had] = 0;
        carryOut();
      }
    }
  }

  void refuse(const char *why) {
    say("error ");
    print(why);
    end();
  }

  void ok(int lines = -1) {
    say("ok ");
    print((unsigned long)millis());
    if (lines >= 0) {
      print(' ');
      print(lines);
    }
    end();
  }

  void carryOut() {
    char *star = strrchr(line, '*');
    if (star) {
      uint16_t found = 0xFFFF;
      for (char *at = line; at < star; at++) found = added(found, *at);
      bool hex = strlen(star) == 5 && strspn(star + 1, "0123456789ABCDEFabcdef") == 4;
      if (!hex || strtoul(star + 1, nullptr, 16) != found) return refuse("checksum");
      *star = 0;
    }
    char *word = strtok(line, " ");
    if (word && isdigit((uint8_t)*word)) {
      number = atoi(word);
      word = strtok(nullptr, " ");
    }
    if (!word) return refuse("no request");
    if (!strcmp(word, "hello")) {
      stop();
      greet();
    } else if (!strcmp(word, "stop")) {
      stop();
      ok();
    } else if (!strcmp(word, "read")) {
      uint32_t passed = millis() - began;
      say("read ");
      print((unsigned long)millis());
      print(' ');
      print((unsigned long)(lasts > passed ? lasts - passed : 0));
      values(*this);
      end();
    } else if (!star) {
      refuse("checksum");  // requests that move the robot need one
    } else if (!strcmp(word, "drive")) {
      drive();
    } else if (!strcmp(word, "lamp")) {
      word = strtok(nullptr, " ");
      bool known = word && (!strcmp(word, "0") || !strcmp(word, "1"));
      known && lamp(*word == '1') ? ok() : refuse("request");
    } else {
      refuse("request");
    }
  }

  void drive() {
    float command[MOST];
    char *word = strtok(nullptr, " "), *rest;
    errno = 0;
    long duration = word ? strtol(word, &rest, 10) : 0;
    if (!word || *rest || errno || duration < 1 || duration > (long)LONGEST)
      return refuse("numbers");
    for (uint8_t i = 0; i < COMMANDS_COUNT; i++) {
      word = strtok(nullptr, " ");
      command[i] = word ? (float)strtod(word, &rest) : 0;
      if (!word || *rest || !(command[i] >= COMMANDS[i].low && command[i] <= COMMANDS[i].high))
        return refuse("numbers");
    }
    if (strtok(nullptr, " ")) return refuse("numbers");
    began = millis();
    lasts = duration;
    move(command);
    ok();
  }

  void greet() {
    int lines = 2;
    say("robot neurosim-lines 1 ");
    print(ROBOT);
    end();
    say("longest ");
    print((unsigned long)LONGEST);
    end();
    for (uint8_t i = 0; i < COMMANDS_COUNT; i++, lines++) {
      const Number &one = COMMANDS[i];
      say("command ");
      print(one.name);
      print(' ');
      print(one.unit);
      print(' ');
      print(one.low, 4);
      print(' ');
      print(one.high, 4);
      print(' ');
      print(one.kind);
      end();
    }
    for (const char *const *at = ABOUT; *at; at++, lines++) {
      say(*at);
      end();
    }
    ok(lines);
  }
};
