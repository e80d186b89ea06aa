/* What a CAN controller tells the module. Called from the board's interrupts. */
#ifndef MODULE_WIRE_CAN_H
#define MODULE_WIRE_CAN_H

#include "mocap_protocol.h"

void can_on_frame(const mocap_can_frame *frame);
void can_on_sent(void);
void can_on_bus_off(void);

#endif
