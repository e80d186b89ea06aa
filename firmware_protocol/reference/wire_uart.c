#include "board.h"
#include "inbox.h"
#include "outbox.h"
#include "wire.h"

#define READY_BELOW 128u /* bytes: 1.3 ms at 1 Mbaud */

static uint8_t received[MOCAP_SENT_SIZE(MOCAP_COMMAND_MAX_SIZE)];
static mocap_frame_decoder decoder;

void wire_begin(void) {
    const uint8_t delimiter = MOCAP_DELIMITER;
    mocap_frame_decoder_init(&decoder, received, sizeof received);
    (void)outbox_put(&delimiter, 1u); /* ends whatever the line made of the start */
}

bool wire_send(uint8_t kind, uint16_t sequence, uint32_t time_us, const uint8_t *body, size_t size) {
    uint8_t sent[MOCAP_SENT_SIZE(WIRE_MOST_BODY)];
    const mocap_wire_frame frame = {MOCAP_PROTOCOL_VERSION, kind, wire_module(), sequence, time_us, body, size};
    return outbox_put(sent, mocap_encode_frame(&frame, sent, sizeof sent));
}

bool wire_is_ready(void) {
    return outbox_size() < READY_BELOW;
}

uint32_t wire_busy_us(void) {
    return board_uart_time_us(outbox_size());
}

bool wire_take(mocap_wire_frame *frame, uint32_t *came_us) {
    uint8_t byte;
    while (inbox_take(&byte, came_us)) {
        if (mocap_frame_decoder_push(&decoder, byte, frame)) {
            return true;
        }
    }
    return false;
}

bool wire_is_quiet(void) {
    return inbox_is_empty();
}
