#include "samples.h"

#include "board.h"

#define WAITING 16u /* a power of two: the indices run freely */
#define TENTHS_OF_US_PER_S 10000000u
#define ALIVE_US 2000000u

/* One producer, the interrupt, and one consumer, the main loop: each writes its own index alone. */
static sample waiting[WAITING];
static volatile uint8_t put, got;

static volatile bool is_running;
static uint16_t rate;      /* 0.1 Hz */
static uint32_t due;       /* counter at the next sample */
static uint32_t remainder; /* of the interval, in 1/rate of a microsecond: 30 Hz must not drift from 30 Hz */
static uint32_t last_timer_us;
static uint16_t sequence;
static volatile sample_counts counts;

static void advance(void) {
    due += TENTHS_OF_US_PER_S / rate;
    remainder += TENTHS_OF_US_PER_S % rate;
    if (remainder >= rate) {
        remainder -= rate;
        ++due;
    }
}

static void take(uint32_t now, uint16_t number, bool is_triggered) {
    sample *place = &waiting[put % WAITING];
    imu_reading reading;
    if (!imu_read(now, &reading)) {
        ++counts.failed;
        return;
    }
    ++counts.taken;
    if ((uint8_t)(put - got) == WAITING) {
        ++counts.dropped;
        return;
    }
    place->sequence = number;
    place->time_us = now;
    place->is_triggered = is_triggered;
    place->reading = reading;
    ++put;
}

void samples_start(uint16_t rate_dhz) {
    const uint32_t before = board_interrupts_off();
    rate = rate_dhz;
    remainder = 0u;
    due = last_timer_us = board_time_us();
    advance();
    is_running = true;
    board_wake_at(due);
    board_interrupts_on(before);
}

void samples_stop(void) {
    const uint32_t before = board_interrupts_off();
    is_running = false;
    board_interrupts_on(before);
}

void samples_trigger(uint16_t number) {
    const uint32_t before = board_interrupts_off();
    take(board_time_us(), number, true);
    board_interrupts_on(before);
}

void samples_on_timer(void) {
    const uint32_t now = board_time_us(); /* first of all: this is the instant of sampling */
    if (!is_running) {
        return;
    }
    if ((int32_t)(now - due) < 0) { /* of an alarm set before the last start */
        board_wake_at(due);
        return;
    }
    last_timer_us = now;
    take(now, sequence++, false);
    advance();
    /* Instants that passed while interrupts were delayed have no sample, and the gap in the numbers shows it. */
    while ((int32_t)(now - due) >= 0) {
        ++sequence;
        ++counts.failed;
        advance();
    }
    board_wake_at(due);
}

/* The interrupt is kept out here and in samples_done() not for the indices' sake: it is what holds the compiler, and a second
 * core, to reading a sample after it was put and before its place is given back. */
const sample *samples_next(void) {
    const uint32_t before = board_interrupts_off();
    const sample *next = put == got ? NULL : &waiting[got % WAITING];
    board_interrupts_on(before);
    return next;
}

void samples_done(bool was_sent) {
    const uint32_t before = board_interrupts_off();
    ++got;
    if (!was_sent) {
        ++counts.dropped;
    }
    board_interrupts_on(before);
}

sample_counts samples_counted(void) {
    const uint32_t before = board_interrupts_off();
    const sample_counts copy = {counts.taken, counts.dropped, counts.failed};
    board_interrupts_on(before);
    return copy;
}

bool samples_are_alive(void) {
    const uint32_t before = board_interrupts_off();
    const uint32_t since = board_time_us() - last_timer_us;
    board_interrupts_on(before);
    return !is_running || since < ALIVE_US;
}
