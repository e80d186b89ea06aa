/* Wire frames on a CAN bus, classic frames: every piece is a frame of its own, the bus arbitrates between modules. */
#include "wire_can.h"

#include "board.h"
#include "reports.h"
#include "wire.h"

#define PIECES 64u /* that wait to be sent; powers of two: the indices run freely */
#define FRAMES 32u /* that came and were not looked at */
#define READY_BELOW 8u
#define FRAME_US 130u     /* of a classic frame of 8 bytes at 1 Mbit/s, with stuffing */
#define COMPLAIN_US 10000000u

typedef struct {
    uint32_t identifier;
    uint8_t length;
    uint8_t data[8];
} piece;

typedef struct {
    mocap_can_frame frame;
    uint32_t came_us;
} arrival;

static piece pieces[PIECES];
static volatile uint8_t pieces_put, pieces_sent;
static arrival arrivals[FRAMES];
static volatile uint8_t arrivals_put, arrivals_got;
static mocap_can_partial partial[2]; /* a command, and a trigger or time request that overtakes it */
static mocap_can_decoder decoder;
static volatile bool was_bus_off;
static bool has_complained;
static uint32_t complained_us;

void wire_begin(void) {
    mocap_can_decoder_init(&decoder, partial, sizeof partial / sizeof *partial);
}

/* Called with interrupts off. */
void can_on_sent(void) {
    while (pieces_put != pieces_sent) {
        const piece *next = &pieces[pieces_sent % PIECES];
        mocap_can_frame frame = {0};
        frame.identifier = next->identifier;
        frame.is_extended = true;
        frame.length = next->length;
        memcpy(frame.data, next->data, sizeof next->data);
        if (!board_can_send(&frame)) {
            return;
        }
        ++pieces_sent;
    }
}

bool wire_send(uint8_t kind, uint16_t sequence, uint32_t time_us, const uint8_t *body, size_t size) {
    const mocap_wire_frame frame = {MOCAP_PROTOCOL_VERSION, kind, wire_module(), sequence, time_us, body, size};
    const size_t count = (size + MOCAP_CAN_OVERHEAD + 7u) / 8u;
    mocap_can_fragmenter fragmenter;
    mocap_can_frame next;
    uint8_t put = pieces_put;
    uint32_t before;
    if (count > PIECES - (uint8_t)(put - pieces_sent) || !mocap_can_fragment(&fragmenter, &frame, false)) {
        return false;
    }
    for (; mocap_can_next(&fragmenter, &next); ++put) {
        pieces[put % PIECES].identifier = next.identifier;
        pieces[put % PIECES].length = next.length;
        memcpy(pieces[put % PIECES].data, next.data, sizeof pieces->data);
    }
    before = board_interrupts_off();
    pieces_put = put;
    can_on_sent();
    board_interrupts_on(before);
    return true;
}

bool wire_is_ready(void) {
    return (uint8_t)(pieces_put - pieces_sent) < READY_BELOW;
}

uint32_t wire_busy_us(void) {
    return (uint8_t)(pieces_put - pieces_sent) * FRAME_US;
}

void can_on_frame(const mocap_can_frame *frame) {
    if ((uint8_t)(arrivals_put - arrivals_got) < FRAMES) {
        arrivals[arrivals_put % FRAMES].frame = *frame;
        arrivals[arrivals_put % FRAMES].came_us = board_time_us();
        ++arrivals_put;
    }
}

void can_on_bus_off(void) {
    pieces_sent = pieces_put; /* what waits is old when the bus is back; the gaps in the numbers show it */
    was_bus_off = true;
}

/* Whether only a host sends this kind. */
static bool is_from_host(uint8_t kind) {
    return kind == MOCAP_KIND_SYNC_REQUEST || kind == MOCAP_KIND_SAMPLING_TRIGGER || kind == MOCAP_KIND_COMMAND ||
           kind == MOCAP_KIND_TRANSFER_TO_MODULE;
}

/* Two modules of one id spoil each other's wire frames, and somebody has to be told. */
static void complain(void) {
    if (!has_complained || board_time_us() - complained_us > COMPLAIN_US) {
        has_complained = true;
        complained_us = board_time_us();
        reports_log(MOCAP_LOG_LINE_LEVEL_ERROR, "another module on the bus sends under id ", wire_module());
    }
}

/* The oldest frame that came. False where there is none. */
static bool take_arrival(arrival *came) {
    const uint32_t before = board_interrupts_off(); /* see samples_next() */
    const bool is_there = arrivals_put != arrivals_got;
    if (is_there) {
        *came = arrivals[arrivals_got % FRAMES];
        ++arrivals_got;
    }
    board_interrupts_on(before);
    return is_there;
}

bool wire_take(mocap_wire_frame *frame, uint32_t *came_us) {
    arrival came;
    if (was_bus_off) {
        was_bus_off = false;
        reports_log(MOCAP_LOG_LINE_LEVEL_WARNING, "the controller had left the bus", REPORTS_NO_NUMBER);
    }
    while (take_arrival(&came)) {
        const uint8_t kind = (uint8_t)(came.frame.identifier >> MOCAP_CAN_KIND_SHIFT & 0xFFu);
        const uint8_t module = (uint8_t)(came.frame.identifier >> MOCAP_CAN_MODULE_SHIFT & 0xFFu);
        *came_us = came.came_us;
        if (!is_from_host(kind)) { /* that of other modules would only push the host's pieces out */
            if (module == wire_module()) {
                complain();
            }
        } else if (mocap_can_decoder_push(&decoder, &came.frame, frame)) {
            return true;
        }
    }
    return false;
}

bool wire_is_quiet(void) {
    return arrivals_put == arrivals_got && !was_bus_off;
}
