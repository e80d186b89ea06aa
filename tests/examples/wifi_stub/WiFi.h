/* A network that is always there. */
#pragma once
#define WL_CONNECTED 3

struct Network {
  void begin(const char *, const char *) {}
  void setSleep(bool) {}
  int status() { return WL_CONNECTED; }
  int RSSI() { return -50; }
};
static Network WiFi;
