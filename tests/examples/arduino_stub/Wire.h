/* An MPU-6050 at rest, z up, that turns at 100 steps about x; absent for the 10th reading. */
#pragma once
#include <stdint.h>

struct WireBus {
  int readings = 0, at = 0;
  void begin() {}
  void setClock(uint32_t) {}
  void beginTransmission(uint8_t) {}
  void write(uint8_t) {}
  void endTransmission(bool = true) {}
  uint8_t requestFrom(uint8_t, uint8_t size) { at = 0; return ++readings == 10 ? 0 : size; }
  int read() {
    static const uint8_t registers[14] = {0, 0, 0, 0, 0x08, 0x00, 0, 0, 0, 100, 0, 0, 0xFF, 0x9C};
    return registers[at++];
  }
};
extern WireBus Wire;
