#include "module.h"

#include "board.h"
#include "commands.h"
#include "imu.h"
#include "reports.h"
#include "samples.h"
#include "store.h"
#include "wire.h"

#define BLINK_US 125000u
#define LONGEST_SLEEP_US 100000u /* the watchdog is fed in between */

static bool is_sampling;
static bool has_trigger; /* one has come since the module samples on them */
static uint16_t last_trigger;
static uint32_t blinks_since, blinks_us;
static bool is_started, is_lit;

static bool is_triggered_mode(void) {
    return store_settings()->mode == MOCAP_SETTINGS_MODE_RAW_SAMPLES_ON_THE_HOST_S_TRIGGER;
}

/* ---- Sampling ---- */

static void restart_timer(void) {
    samples_stop();
    if (is_sampling && !is_triggered_mode()) {
        samples_start(store_settings()->sampling_rate);
    }
}

void module_start_sampling(void) {
    if (!is_sampling) {
        is_sampling = true;
        restart_timer();
    }
}

void module_stop_sampling(void) {
    is_sampling = false;
    samples_stop();
}

static void follow_trigger(const mocap_wire_frame *frame) {
    mocap_sampling_trigger trigger;
    if (!is_sampling || !is_triggered_mode() ||
        mocap_decode_sampling_trigger(frame->body, frame->body_size, &trigger) != MOCAP_GOOD) {
        return;
    }
    if (has_trigger && trigger.number == last_trigger) {
        return; /* it comes twice where the radio repeats it */
    }
    has_trigger = true;
    last_trigger = trigger.number;
    samples_trigger(trigger.number);
}

/* False where the line was full, or nothing waited. */
static bool send_sample(void) {
    const sample *taken = samples_next();
    uint8_t body[MOCAP_INERTIAL_SAMPLE_MAX_SIZE];
    mocap_inertial_sample packet;
    if (taken == NULL) {
        return false;
    }
    memcpy(packet.specific_force, taken->reading.specific_force, sizeof packet.specific_force);
    memcpy(packet.angular_rate, taken->reading.angular_rate, sizeof packet.angular_rate);
    memcpy(packet.magnetic_field, taken->reading.magnetic_field, sizeof packet.magnetic_field);
    packet.mask = (uint8_t)(taken->reading.present | taken->reading.clipped |
                            (taken->is_triggered ? MOCAP_INERTIAL_SAMPLE_TRIGGERED : 0u));
    samples_done(wire_send(MOCAP_KIND_INERTIAL_SAMPLE, taken->sequence, taken->time_us, body,
                           mocap_encode_inertial_sample(&packet, body, sizeof body)));
    return true;
}

/* ---- Time ---- */

static void answer_time_request(const mocap_wire_frame *frame, uint32_t came_us) {
    mocap_sync_request request;
    mocap_sync_response response;
    uint8_t body[MOCAP_SYNC_RESPONSE_MAX_SIZE];
    if (mocap_decode_sync_request(frame->body, frame->body_size, &request) != MOCAP_GOOD) {
        return;
    }
    response.token = request.token;
    response.received_us = came_us;
    response.sent_us = board_time_us() + wire_busy_us(); /* when the line is free for it */
    (void)wire_report(MOCAP_KIND_SYNC_RESPONSE, response.sent_us, body,
                      mocap_encode_sync_response(&response, body, sizeof body));
}

/* ---- Light ---- */

void module_blink(uint8_t seconds) {
    blinks_since = board_time_us();
    blinks_us = seconds * 1000000u;
}

static void work_light(void) {
    const uint32_t since = board_time_us() - blinks_since;
    if (since >= blinks_us) {
        blinks_us = 0u; /* or it would blink again when the counter has gone round */
    }
    if (is_lit != (blinks_us > 0u && since / BLINK_US % 2u == 0u)) {
        is_lit = !is_lit;
        board_led(is_lit);
    }
}

/* ---- All of it ---- */

void module_act_by_settings(void) {
    const mocap_settings *settings = store_settings();
    imu_setup setup;
    samples_stop(); /* whoever reads the sensors meanwhile would cut a transfer of theirs in two */
    if (!imu_configure(settings, &setup)) {
        reports_log(MOCAP_LOG_LINE_LEVEL_ERROR, "the inertial sensors do not answer", REPORTS_NO_NUMBER);
    }
    wire_set_module(settings->module_id);
    has_trigger = false;
    if (is_started) {
        reports_set_setup(&setup);
    } else {
        reports_begin(&setup);
    }
    restart_timer();
}

void module_begin(void) {
    board_watchdog_begin(); /* first: sensors that do not answer may hold up what follows */
    store_begin();
    wire_begin();
    is_sampling = true;
    module_act_by_settings();
    is_started = true;
    (void)reports_work(); /* DeviceInfo is the first to be heard */
    reports_log(MOCAP_LOG_LINE_LEVEL_INFO, board_reset_cause(), REPORTS_NO_NUMBER);
    if (store_is_factory()) {
        reports_event(MOCAP_EVENT_STARTED_FROM_THE_FACTORY_SETTINGS, 0u);
    }
}

static void take_what_came(void) {
    mocap_wire_frame frame;
    uint32_t came_us = 0u;
    while (wire_take(&frame, &came_us)) {
        const bool is_for_me = frame.module == wire_module() || frame.module == MOCAP_BROADCAST;
        if (frame.kind == MOCAP_KIND_COMMAND) {
            commands_take(&frame); /* one by unique id concerns this module whatever its id */
            (void)commands_work(); /* before so many have come that their answers are forgotten */
        } else if (is_for_me && frame.kind == MOCAP_KIND_SYNC_REQUEST) {
            answer_time_request(&frame, came_us);
        } else if (is_for_me && frame.kind == MOCAP_KIND_SAMPLING_TRIGGER) {
            follow_trigger(&frame);
        }
    }
}

void module_work(void) {
    uint32_t sleep_us = LONGEST_SLEEP_US, to_report, to_answer, before;
    take_what_came();
    to_answer = commands_work();
    while (wire_is_ready() && send_sample()) {
    }
    to_report = reports_work();
    work_light();
    if (samples_are_alive()) {
        board_watchdog_feed();
    }
    sleep_us = to_report < sleep_us ? to_report : sleep_us;
    sleep_us = to_answer < sleep_us ? to_answer : sleep_us;
    before = board_interrupts_off();
    if (wire_is_quiet() && (samples_next() == NULL || !wire_is_ready())) {
        const uint32_t begun = board_time_us();
        board_idle(sleep_us);
        reports_slept(board_time_us() - begun);
    }
    board_interrupts_on(before);
}
