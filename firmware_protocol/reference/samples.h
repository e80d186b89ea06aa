/* Samples from the timer interrupt to the main loop: taken and stamped there, sent here. */
#ifndef MODULE_SAMPLES_H
#define MODULE_SAMPLES_H

#include "imu.h"

typedef struct {
    uint16_t sequence;
    uint32_t time_us; /* the counter, in the interrupt */
    bool is_triggered;
    imu_reading reading;
} sample;

typedef struct {
    uint32_t taken;
    uint16_t dropped; /* taken, and not sent */
    uint16_t failed;  /* the sensor did not answer, or the interrupt came too late */
} sample_counts;

/* Samples by the timer from now on, this many tenths of a sample each second. */
void samples_start(uint16_t rate_dhz);

/* Samples no more by the timer: the sensors are not read after this. */
void samples_stop(void);

/* Takes one now, under the host's number. */
void samples_trigger(uint16_t number);

/* The board's alarm has come. Called from its interrupt. */
void samples_on_timer(void);

/* The oldest sample that waits, or NULL. It stays until samples_done(). */
const sample *samples_next(void);
void samples_done(bool was_sent);

sample_counts samples_counted(void);

/* Whether the timer has done its work within the last two seconds, as far as it had any. */
bool samples_are_alive(void);

#endif
