/* Commands of the host: obeyed once, answered as often as they come. */
#ifndef MODULE_COMMANDS_H
#define MODULE_COMMANDS_H

#include "mocap_protocol.h"

/* A command has come, for this module or another. */
void commands_take(const mocap_wire_frame *frame);

/* Sends answers that are due. How long until the next is, us. */
uint32_t commands_work(void);

#endif
