#include <Arduino.h>
#include <Wire.h>

WireBus Wire;
#define MODULE_ID ((uint8_t)atoi(getenv("MODULE")))
#define GATEWAY_HOST "127.0.0.1"
#define GATEWAY_PORT atoi(getenv("PORT"))

#include "wifi_module.ino"

int main() {
  setup();
  for (;;) {
    loop();
    usleep(1000);
  }
}
