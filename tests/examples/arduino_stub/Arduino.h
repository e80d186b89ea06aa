/* As much of Arduino as the example sketch uses: simulated time, Serial on standard input and output. */
#pragma once
#include <stdint.h>
#include <stddef.h>
#include <stdio.h>

extern uint32_t simulated_us;
inline uint32_t micros() { return simulated_us += 7; }

struct SerialPort {
  void begin(uint32_t) {}
  int next = EOF;
  bool has_next = false;
  int available() {
    if (!has_next) { next = getchar(); has_next = true; }
    return next != EOF;
  }
  int read() { has_next = false; return next; }
  size_t write(const uint8_t *data, size_t size) { return fwrite(data, 1, size, stdout); }
};
extern SerialPort Serial;
