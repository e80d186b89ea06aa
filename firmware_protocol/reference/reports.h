/* What the module says of itself on its own: who it is, how it fares, what happened. */
#ifndef MODULE_REPORTS_H
#define MODULE_REPORTS_H

#include "imu.h"

/* From now on; `setup` is what the sensors were set to. */
void reports_begin(const imu_setup *setup);
void reports_set_setup(const imu_setup *setup);

/* Sends what is due. How long until the next is, us. */
uint32_t reports_work(void);

/* The main loop has slept for so long; what is left of a second is how busy the module is. */
void reports_slept(uint32_t us);

/* Sends DeviceInfo and Health now, and to the log how much of stack and time the firmware uses. */
void reports_introduce(void);

void reports_event(uint8_t event, uint8_t value);

/* A line of the log, cut off where it is too long. A number is put at its end where one is given (not UINT32_MAX). */
#define REPORTS_NO_NUMBER 0xFFFFFFFFu
void reports_log(uint8_t level, const char *text, uint32_t number);

#endif
