/* Datagrams over a socket of this machine; its own port is any free one, as ten modules share the machine. */
#pragma once
#include <arpa/inet.h>
#include <netinet/in.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>

struct WiFiUDP {
  int opened = -1;
  uint8_t outgoing[1500], incoming[1500];
  size_t outgoing_size = 0;
  ssize_t incoming_size = 0, at = 0;
  sockaddr_in target = {};

  void begin(int) { opened = socket(AF_INET, SOCK_DGRAM, 0); }
  int beginPacket(const char *host, int port) {
    target.sin_family = AF_INET;
    target.sin_port = htons((uint16_t)port);
    inet_pton(AF_INET, host, &target.sin_addr);
    outgoing_size = 0;
    return 1;
  }
  size_t write(const uint8_t *data, size_t size) {
    memcpy(outgoing + outgoing_size, data, size);
    outgoing_size += size;
    return size;
  }
  int endPacket() {
    return sendto(opened, outgoing, outgoing_size, 0, (sockaddr *)&target, sizeof target) == (ssize_t)outgoing_size;
  }
  int parsePacket() {
    at = 0;
    incoming_size = recv(opened, incoming, sizeof incoming, MSG_DONTWAIT);
    return incoming_size > 0 ? (int)incoming_size : 0;
  }
  int available() { return (int)(incoming_size - at); }
  int read() { return incoming[at++]; }
};
