/* The lines from the modules to the relay, one each. */
#ifndef RELAY_PORTS_H
#define RELAY_PORTS_H

#include "mocap_protocol.h"

#define PORTS_MOST 8u

uint8_t board_ports(void);

/* What has come by a port since the last time; 0 where nothing has. */
size_t board_port_read(uint8_t port, uint8_t *data, size_t size);

/* Sends to a module; what its line does not take is lost, and the host asks again. */
void board_port_write(uint8_t port, const uint8_t *data, size_t size);

#endif
