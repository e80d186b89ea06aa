/* As much of an ESP32 as the wireless sketch uses: this machine's clock, a light that says when it first shines. */
#pragma once
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

#define OUTPUT 1

inline uint64_t now_us() {
  timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return 1000000u * (uint64_t)now.tv_sec + now.tv_nsec / 1000u;
}
inline uint32_t micros() { return (uint32_t)now_us(); }
inline uint32_t millis() { return (uint32_t)(now_us() / 1000u); }
inline void delay(uint32_t ms) { usleep(1000u * ms); }
inline void pinMode(int, int) {}
inline void digitalWrite(int, bool is_on) {
  static bool was_on = false;
  if (is_on && !was_on) {
    was_on = true;
    puts("shines");
    fflush(stdout);
  }
}

struct Chip {
  uint64_t getEfuseMac() { return 0xABCD00u + (uint64_t)atoi(getenv("MODULE")); }
};
static Chip ESP;
