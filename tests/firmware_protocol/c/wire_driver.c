/* Reads cases on standard input, says in text what the header makes of each.
 *
 * A case is [what:1] [size:4] [data:size]; the answer is lines, the last of them "end". What:
 *   s  a byte stream: every wire frame and packet, decoded and encoded anew; what was dropped
 *   c  records of a CAN link: the same
 *   p  [kind:1] [body]: the packet's fields, and the body encoded anew
 *   v  [verb:1] [part:1, a p e] [bytes]: arguments, payload or entry, decoded and encoded anew
 *   k  [key:1] [value]: a setting, written into the settings and read back
 */
#include <stdio.h>
#include <stdlib.h>

#include "mocap_protocol.h"

static void print_hex(const uint8_t *data, size_t size) {
    size_t i;
    for (i = 0; i < size; ++i) {
        printf("%02x", data[i]);
    }
}

static void print_bytes(const char *name, const uint8_t *data, size_t size) {
    printf("%s ", name);
    print_hex(data, size);
    printf("\n");
}

#include "generated_fields.h" /* print_packet, recode_verb: written by the test from the declarations */

static uint32_t packet_drops[MOCAP_DEFECTS];

static void take_packet(const mocap_wire_frame *frame) {
    mocap_packet packet;
    uint8_t body[MOCAP_MAX_BODY_SIZE];
    const mocap_defect defect = mocap_open_packet(frame, &packet);
    size_t size;
    if (defect != MOCAP_GOOD) {
        ++packet_drops[defect];
        return;
    }
    size = mocap_encode_packet(&packet, body, sizeof body);
    printf("packet %u %u %u %lu ", frame->kind, frame->module, frame->sequence,
            (unsigned long)frame->module_time_us);
    print_hex(body, size);
    printf("\n");
}

static void take_batch(const mocap_wire_frame *frame) {
    uint8_t again[MOCAP_MAX_BODY_SIZE];
    mocap_relay_batch batch;
    mocap_wire_frame entry;
    size_t offset = 0;
    if (frame->module != MOCAP_RELAY) {
        ++packet_drops[MOCAP_BAD_MODULE];
        return;
    }
    mocap_relay_begin(&batch, again, sizeof again);
    while (offset < frame->body_size) {
        if (mocap_relay_next(frame->body, frame->body_size, &offset, &entry) != MOCAP_GOOD) {
            ++packet_drops[MOCAP_TRUNCATED];
            break;
        }
        take_packet(&entry);
        (void)mocap_relay_add(&batch, &entry);
    }
    print_bytes("batch", batch.body, batch.size);
}

static void print_can(const char *name, const mocap_wire_frame *frame, bool is_fd) {
    mocap_can_fragmenter fragmenter;
    mocap_can_frame piece;
    if (!mocap_can_fragment(&fragmenter, frame, is_fd)) {
        return;
    }
    printf("%s ", name);
    while (mocap_can_next(&fragmenter, &piece)) {
        uint8_t record[6];
        (void)mocap_put_u32(record, piece.identifier | (piece.is_extended ? 0x80000000u : 0u));
        record[4] = piece.is_fd ? 3u : 0u;
        record[5] = piece.length;
        print_hex(record, sizeof record);
        print_hex(piece.data, piece.length);
    }
    printf("\n");
}

static void take_frame(const mocap_wire_frame *frame) {
    uint8_t sent[MOCAP_MAX_STUFFED_SIZE + 1u];
    print_bytes("frame", sent, mocap_encode_frame(frame, sent, sizeof sent));
    print_can("classic", frame, false);
    print_can("fd", frame, true);
    if (frame->kind == MOCAP_KIND_RELAY_BATCH) {
        take_batch(frame);
    } else {
        take_packet(frame);
    }
}

static void print_drops(const uint32_t drops[MOCAP_DEFECTS]) {
    size_t i;
    for (i = 1; i < MOCAP_DEFECTS; ++i) {
        if (drops[i] + packet_drops[i] > 0u) {
            printf("dropped %u %lu\n", (unsigned)i, (unsigned long)(drops[i] + packet_drops[i]));
        }
    }
}

static void take_stream(const uint8_t *data, size_t size) {
    static uint8_t buffer[MOCAP_MAX_STUFFED_SIZE];
    mocap_frame_decoder decoder;
    mocap_wire_frame frame;
    size_t i;
    mocap_frame_decoder_init(&decoder, buffer, sizeof buffer);
    for (i = 0; i < size; ++i) {
        if (mocap_frame_decoder_push(&decoder, data[i], &frame)) {
            take_frame(&frame);
        }
    }
    print_drops(decoder.dropped);
    printf("accepted %lu\n", (unsigned long)decoder.accepted);
}

static void take_can(const uint8_t *data, size_t size) {
    static mocap_can_partial partial[256];
    mocap_can_decoder decoder;
    mocap_wire_frame frame;
    size_t at = 0;
    mocap_can_decoder_init(&decoder, partial, 256);
    while (size - at >= 6u) {
        const uint32_t flagged = mocap_get_u32(data + at);
        mocap_can_frame piece;
        memset(&piece, 0, sizeof piece);
        piece.identifier = flagged & 0x1FFFFFFFu;
        piece.is_extended = (flagged & 0x80000000u) != 0u;
        piece.is_remote = (flagged & 0x40000000u) != 0u;
        piece.is_error = (flagged & 0x20000000u) != 0u;
        piece.is_fd = (data[at + 4u] & 1u) != 0u;
        piece.length = data[at + 5u];
        if (piece.length > size - at - 6u || piece.length > (piece.is_fd ? 64u : 8u)) {
            break;
        }
        memcpy(piece.data, data + at + 6u, piece.length);
        at += 6u + (size_t)piece.length;
        if (mocap_can_decoder_push(&decoder, &piece, &frame)) {
            take_frame(&frame);
        }
    }
    if (at < size) {
        ++packet_drops[MOCAP_TRUNCATED];
    }
    print_drops(decoder.dropped);
    printf("accepted %lu\n", (unsigned long)decoder.accepted);
}

static void take_body(const uint8_t *data, size_t size) {
    mocap_packet packet;
    uint8_t body[MOCAP_MAX_BODY_SIZE];
    const mocap_defect defect = mocap_decode_packet(data[0], data + 1, size - 1u, &packet);
    if (defect != MOCAP_GOOD) {
        printf("defect %u\n", (unsigned)defect);
        return;
    }
    print_packet(&packet);
    print_bytes("body", body, mocap_encode_packet(&packet, body, sizeof body));
}

static void take_setting(const uint8_t *data, size_t size) {
    mocap_settings settings;
    uint8_t value[MOCAP_MAX_SETTING_SIZE];
    mocap_settings_set_factory(&settings);
    printf("result %u\n", (unsigned)mocap_settings_write(&settings, data[0], data + 1, size - 1u));
    print_bytes("value", value, mocap_settings_read(&settings, data[0], value, sizeof value));
    printf("valid %d\n", mocap_settings_is_valid(&settings));
}

int main(void) {
    uint8_t head[5];
    while (fread(head, 1, sizeof head, stdin) == sizeof head) {
        const size_t size = mocap_get_u32(head + 1);
        uint8_t *data = (uint8_t *)malloc(size + 1u); /* exactly as long as said, for the sanitizer */
        if (data == NULL || fread(data, 1, size, stdin) != size) {
            return 1;
        }
        data = (uint8_t *)realloc(data, size > 0u ? size : 1u);
        memset(packet_drops, 0, sizeof packet_drops);
        switch (head[0]) {
            case 's': take_stream(data, size); break;
            case 'c': take_can(data, size); break;
            case 'p': take_body(data, size); break;
            case 'v': recode_verb(data[0], (char)data[1], data + 2, size - 2u); break;
            case 'k': take_setting(data, size); break;
            default: return 2;
        }
        printf("end\n");
        free(data);
    }
    return 0;
}
