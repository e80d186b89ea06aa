/* A relay unit: what its modules send goes on in batches, what the host says goes to all of them.
 *
 * It stands in the place of module.c, and obeys commands itself, under its own id. Answers and time responses do not wait for the
 * next batch: the host measures how long they take.
 */
#include "board.h"
#include "card.h"
#include "commands.h"
#include "module.h"
#include "outbox.h"
#include "ports.h"
#include "recorder.h"
#include "reports.h"
#include "store.h"
#include "wire.h"

#define TICK_US 10000u
#define LOOK_US 500u /* the ports are looked at as often */
#define BLINK_US 125000u

static mocap_frame_decoder decoders[PORTS_MOST];
static uint8_t received[PORTS_MOST][MOCAP_SENT_SIZE(MOCAP_COMMAND_MAX_SIZE)];
static mocap_relay_batch batch;
static uint8_t batch_body[WIRE_MOST_BODY];
static uint16_t batches;
static uint32_t tick_due, blinks_since, blinks_us;
static bool is_lit;

static void say_full(void) {
    reports_log(MOCAP_LOG_LINE_LEVEL_WARNING, "the card is full: nothing more is recorded", REPORTS_NO_NUMBER);
}

void module_start_sampling(void) {
    if (card_is_there() && !recorder_begin(board_time_us())) {
        say_full();
    }
}

void module_stop_sampling(void) {
    recorder_end();
}

void module_blink(uint8_t seconds) {
    blinks_since = board_time_us();
    blinks_us = seconds * 1000000u;
}

void module_act_by_settings(void) { /* its id is fixed, whatever the settings say */
    wire_set_module(MOCAP_RELAY);
}

static void send_batch(void) {
    if (batch.size > 0u) {
        (void)wire_send(MOCAP_KIND_RELAY_BATCH, batches++, board_time_us(), batch_body, batch.size);
    }
    mocap_relay_begin(&batch, batch_body, sizeof batch_body);
}

static void record(const mocap_wire_frame *frame) {
    uint8_t sent[MOCAP_SENT_SIZE(MOCAP_ACKNOWLEDGEMENT_MAX_SIZE)];
    if (!recorder_write(sent, mocap_encode_frame(frame, sent, sizeof sent))) {
        say_full();
    }
}

static void pass_on(const mocap_wire_frame *frame) {
    record(frame);
    if (frame->kind == MOCAP_KIND_SYNC_RESPONSE || frame->kind == MOCAP_KIND_ACKNOWLEDGEMENT) {
        uint8_t sent[MOCAP_SENT_SIZE(MOCAP_ACKNOWLEDGEMENT_MAX_SIZE)];
        (void)outbox_put(sent, mocap_encode_frame(frame, sent, sizeof sent));
        return;
    }
    if (!mocap_relay_add(&batch, frame)) {
        send_batch();
        (void)mocap_relay_add(&batch, frame);
    }
}

static void gather(void) {
    uint8_t port, bytes[128];
    for (port = 0u; port < board_ports(); ++port) {
        size_t size, i;
        while ((size = board_port_read(port, bytes, sizeof bytes)) > 0u) {
            for (i = 0u; i < size; ++i) {
                mocap_wire_frame frame;
                if (mocap_frame_decoder_push(&decoders[port], bytes[i], &frame)) {
                    pass_on(&frame);
                }
            }
        }
    }
}

static void send_to_modules(const mocap_wire_frame *frame) {
    uint8_t port, sent[MOCAP_SENT_SIZE(MOCAP_COMMAND_MAX_SIZE)];
    const size_t size = mocap_encode_frame(frame, sent, sizeof sent);
    for (port = 0u; port < board_ports(); ++port) {
        board_port_write(port, sent, size);
    }
}

static void take_what_came(void) {
    mocap_wire_frame frame;
    uint32_t came_us;
    while (wire_take(&frame, &came_us)) {
        if (frame.module != MOCAP_RELAY) {
            send_to_modules(&frame);
        }
        if (frame.kind == MOCAP_KIND_COMMAND) {
            commands_take(&frame);
        }
    }
}

static void work_light(void) {
    const uint32_t since = board_time_us() - blinks_since;
    if (since >= blinks_us) {
        blinks_us = 0u;
    }
    if (is_lit != (blinks_us > 0u && since / BLINK_US % 2u == 0u)) {
        is_lit = !is_lit;
        board_led(is_lit);
    }
}

void module_begin(void) {
    static const imu_setup none;
    uint8_t port;
    store_begin();
    recorder_mount();
    wire_begin();
    wire_set_module(MOCAP_RELAY);
    for (port = 0u; port < PORTS_MOST; ++port) {
        mocap_frame_decoder_init(&decoders[port], received[port], sizeof received[port]);
    }
    mocap_relay_begin(&batch, batch_body, sizeof batch_body);
    reports_begin(&none);
    tick_due = board_time_us();
    board_watchdog_begin();
}

void module_work(void) {
    uint32_t before;
    take_what_came();
    gather();
    if ((int32_t)(board_time_us() - tick_due) >= 0) {
        send_batch();
        tick_due += TICK_US;
    }
    recorder_work(board_time_us());
    (void)commands_work();
    (void)reports_work();
    work_light();
    board_watchdog_feed();
    before = board_interrupts_off();
    if (wire_is_quiet()) {
        board_idle(LOOK_US);
    }
    board_interrupts_on(before);
}
