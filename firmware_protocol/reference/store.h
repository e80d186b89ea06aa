/* What outlives a loss of power: the settings in two slots, and how often the module started. */
#ifndef MODULE_STORE_H
#define MODULE_STORE_H

#include "mocap_protocol.h"

/* Reads the settings, and counts this start. */
void store_begin(void);

/* What the module acts by. */
const mocap_settings *store_settings(void);

/* Whether no settings were ever committed, or none of them can be read. */
bool store_is_factory(void);

/* Starts since the firmware was installed, but for the first. */
uint16_t store_resets(void);

/* The bytes of a setting, the staged ones where there are any; 0 for a key that there is not. */
size_t store_read(uint8_t key, uint8_t *value, size_t capacity);

mocap_result store_stage(uint8_t key, const uint8_t *value, size_t size);
void store_discard(void);

/* All that is staged becomes what the module acts by, or nothing of it. */
mocap_result store_commit(uint32_t *generation);
mocap_result store_factory_reset(uint32_t *generation);

#endif
