/* A sensor module: begin it once, then let it work for ever. */
#ifndef MODULE_MODULE_H
#define MODULE_MODULE_H

#include "mocap_protocol.h"

void module_begin(void);

/* One turn of the main loop; sleeps at its end where nothing is left to do. */
void module_work(void);

/* What commands do to it. */

void module_start_sampling(void);
void module_stop_sampling(void);

/* Blinks for so many seconds; 0 stops it. */
void module_blink(uint8_t seconds);

/* The settings have changed. */
void module_act_by_settings(void);

#endif
