#include <Arduino.h>
#include <Wire.h>

uint32_t simulated_us = 0xFFFFFF00u; /* the clock wraps soon */
SerialPort Serial;
WireBus Wire;

#include "imu_module.ino"

int main() {
  setup();
  for (int i = 0; i < 100000; ++i) {
    simulated_us += 3;
    loop();
  }
  return 0;
}
