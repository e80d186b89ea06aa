/* What is the same for every carrier: the id, and the number of each kind. */
#include "wire.h"

#define FIRST_KIND MOCAP_KIND_DEVICE_INFO
#define KINDS (MOCAP_KIND_ACKNOWLEDGEMENT - FIRST_KIND + 1)

static uint16_t sequences[KINDS];
static uint8_t own_module;

bool wire_report(uint8_t kind, uint32_t time_us, const uint8_t *body, size_t size) {
    return wire_send(kind, sequences[kind - FIRST_KIND]++, time_us, body, size);
}

void wire_set_module(uint8_t module) {
    own_module = module;
}

uint8_t wire_module(void) {
    return own_module;
}
