/* mocap_protocol.h: the wire of the motion-capture modules, for firmware.
 *
 * Written by `python -m firmware_protocol.c.generate` from the declarations of the Python package
 * firmware_protocol; change those (or firmware_protocol/c/parts), not this file.
 *
 * One header, C99 or C++11, nothing else to build or link. It allocates nothing, holds no state of
 * its own, and assumes neither byte order nor alignment. Structs hold the raw integers of the wire,
 * so that encoding does no floating-point arithmetic; the *_to_si and *_from_si helpers convert.
 *
 * Send a sample (example.c is a whole program):
 *
 *     mocap_inertial_sample sample = {0};
 *     uint8_t body[MOCAP_INERTIAL_SAMPLE_MAX_SIZE], sent[64];
 *     mocap_inertial_sample_set_specific_force(&sample, x, y, z);
 *     size_t size = mocap_encode_inertial_sample(&sample, body, sizeof body);
 *     mocap_wire_frame frame = {MOCAP_PROTOCOL_VERSION, MOCAP_KIND_INERTIAL_SAMPLE,
 *                               module, sequence, time_us, body, size};
 *     uart_write(sent, mocap_encode_frame(&frame, sent, sizeof sent));
 *
 * Receive: give each byte to mocap_frame_decoder_push(), each CAN frame to mocap_can_decoder_push().
 *
 * On a signed link (UDP, TCP), with a mocap_signing for both directions: mocap_sign() makes what is sent
 * before each wire frame; each byte received goes to mocap_signed_decoder_push() instead.
 *
 * Encoders return the number of bytes written, 0 when the value cannot be sent or does not fit.
 * Decoders return MOCAP_GOOD or why the bytes were refused; pointers in what they decode point into
 * the bytes decoded.
 *
 * May be defined before inclusion:
 *     MOCAP_REAL               type of the SI helpers; float
 *     MOCAP_CRC_BITWISE        no table for the checksum: 64 bytes smaller, four times slower
 *     MOCAP_CAN_BODY_CAPACITY  largest body that is reassembled from CAN; MOCAP_CAN_MAX_BODY_SIZE
 */
#ifndef MOCAP_PROTOCOL_H
#define MOCAP_PROTOCOL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#ifdef __cplusplus
extern "C" {
#endif

#ifndef MOCAP_REAL
#define MOCAP_REAL float
#endif

/* ---- Constants of the protocol ------------------------------------------------------------------- */

#define MOCAP_PROTOCOL_VERSION 1u
#define MOCAP_LOWEST_VERSION 1u /* spoken by this header */
#define MOCAP_HIGHEST_VERSION 1u
#define MOCAP_NO_VERSION 0u
#define MOCAP_DELIMITER 0u
#define MOCAP_MAX_MODULE 63u /* largest id of a module */
#define MOCAP_RELAY 254u /* the relay's id */
#define MOCAP_BROADCAST 255u /* from the host: every module */
#define MOCAP_HEADER_SIZE 9u /* version, kind, module, sequence, module_time_us */
#define MOCAP_MIN_FRAME_SIZE 13u /* header and checksum */
#define MOCAP_MAX_FRAME_SIZE 4096u /* before stuffing */
#define MOCAP_MAX_BODY_SIZE 4083u
#define MOCAP_MAX_STUFFED_SIZE 4113u /* without delimiter */
#define MOCAP_KEY_SIZE 32u /* of a signed link */
#define MOCAP_TAG_SIZE 8u
#define MOCAP_SIGNATURE_MARK 129u
#define MOCAP_SIGNATURE_SIZE 19u /* mark, signer, count, tag */
#define MOCAP_SENT_SIGNATURE_SIZE 21u /* stuffed, with its delimiter */
#define MOCAP_HOST_SIGNER 0u
#define MOCAP_RELAY_ENTRY_SIZE 9u /* before the body of an entry */
#define MOCAP_RELAY_MAX_ENTRY_BODY_SIZE 255u
#define MOCAP_CAN_HEAD_SIZE 7u /* sequence, module_time_us, body_length */
#define MOCAP_CAN_OVERHEAD 11u /* head and checksum */
#define MOCAP_CAN_MAX_BODY_SIZE 255u /* CAN FD */
#define MOCAP_CAN_MAX_CLASSIC_BODY_SIZE 245u
#define MOCAP_CAN_MAX_PADDING 15u /* CAN FD */
#define MOCAP_UNIQUE_ID_SIZE 12u
#define MOCAP_ANSWER_MEMORY 8u /* answers that a device remembers */
#define MOCAP_BROADCAST_ANSWER_DELAY_US 2000u /* times the device's id */
#define MOCAP_FACTORY_RESET_MAGIC 1178682196u
#define MOCAP_ALL_FILES 65535u
#define MOCAP_SLOT_MAGIC 1296519985u
#define MOCAP_SLOT_MAGIC_SIZE 4u
#define MOCAP_SLOT_HEAD_SIZE 12u /* magic, generation, length, reserved */
#define MOCAP_SLOT_ENTRY_SIZE 2u /* key, size */
#define MOCAP_SLOT_IMAGE_SIZE 186u /* a slot with every setting */

/* CAN identifier, 29 bits; name:bits [lowest bit]: priority:3 [26], kind:8 [18], module:8 [10],
 * version:4 [6], last:1 [5], index:5 [0] */
#define MOCAP_CAN_PRIORITY_SHIFT 26u
#define MOCAP_CAN_KIND_SHIFT 18u
#define MOCAP_CAN_MODULE_SHIFT 10u
#define MOCAP_CAN_VERSION_SHIFT 6u
#define MOCAP_CAN_LAST_SHIFT 5u
#define MOCAP_CAN_INDEX_SHIFT 0u

/* Why received bytes were dropped. */
typedef enum {
    /* nothing was wrong */
    MOCAP_GOOD = 0,
    /* more bytes than the largest wire frame came without a delimiter */
    MOCAP_OVERLONG = 1,
    /* the bytes between two delimiters are no COBS encoding */
    MOCAP_BAD_STUFFING = 2,
    /* there are fewer bytes than header and checksum need */
    MOCAP_TOO_SHORT = 3,
    /* the checksum does not fit the bytes */
    MOCAP_BAD_CRC = 4,
    /* the protocol version is not 1 */
    MOCAP_BAD_VERSION = 5,
    /* this version does not define the kind */
    MOCAP_UNKNOWN_KIND = 6,
    /* the body is longer or shorter than it says or than its kind and mask demand */
    MOCAP_BAD_LENGTH = 7,
    /* a field has a value that it does not allow: reserved, not finite or out of range */
    MOCAP_BAD_VALUE = 8,
    /* a module of this id cannot send this */
    MOCAP_BAD_MODULE = 9,
    /* an entry or record runs past the end of what carries it */
    MOCAP_TRUNCATED = 10,
    /* the CAN frame is somebody else's: short identifier, remote, error or other version */
    MOCAP_FOREIGN = 11,
    /* a CAN piece was lost, repeated or out of order */
    MOCAP_LOST_FRAGMENT = 12,
    /* the link is signed, and this came without a signature */
    MOCAP_UNSIGNED = 13,
    /* the signature fits neither the key nor the bytes, or is the receiver's own */
    MOCAP_BAD_SIGNATURE = 14,
    /* the count of the signature has come before */
    MOCAP_REPLAYED = 15,
    /* the count of the signature is older than the window or the receiver's start */
    MOCAP_OUTDATED = 16
} mocap_defect;

#define MOCAP_DEFECTS 17u /* how many counters there are */

/* What a wire frame carries. */
typedef enum {
    MOCAP_KIND_INERTIAL_SAMPLE = 16,
    MOCAP_KIND_INERTIAL_SAMPLE_FINE = 17,
    MOCAP_KIND_FUSED_SAMPLE = 18,
    MOCAP_KIND_LOCAL_MEASUREMENT = 24,
    MOCAP_KIND_LIGHT_SAMPLE = 25,
    MOCAP_KIND_PRESSURE_SAMPLE = 26,
    MOCAP_KIND_PASS_THROUGH = 27,
    MOCAP_KIND_RELAY_BATCH = 32,
    MOCAP_KIND_DEVICE_INFO = 48,
    MOCAP_KIND_HEALTH = 49,
    MOCAP_KIND_EVENT = 50,
    MOCAP_KIND_LOG_LINE = 51,
    /* from the host */
    MOCAP_KIND_SYNC_REQUEST = 64,
    MOCAP_KIND_SYNC_RESPONSE = 65,
    /* from the host */
    MOCAP_KIND_SAMPLING_TRIGGER = 66,
    /* from the host */
    MOCAP_KIND_COMMAND = 80,
    MOCAP_KIND_ACKNOWLEDGEMENT = 81,
    /* from the host */
    MOCAP_KIND_TRANSFER_TO_MODULE = 94,
    MOCAP_KIND_TRANSFER_TO_HOST = 95
} mocap_kind;

/* Arbitration priority of a kind: 0 wins over all, 7 yields to all. */
static inline uint8_t mocap_can_priority(uint8_t kind) {
    switch (kind) {
        case MOCAP_KIND_SYNC_REQUEST:
        case MOCAP_KIND_SAMPLING_TRIGGER:
            return 0u;
        case MOCAP_KIND_SYNC_RESPONSE:
        case MOCAP_KIND_COMMAND:
        case MOCAP_KIND_ACKNOWLEDGEMENT:
            return 1u;
        case MOCAP_KIND_LOCAL_MEASUREMENT:
        case MOCAP_KIND_PRESSURE_SAMPLE:
        case MOCAP_KIND_PASS_THROUGH:
            return 2u;
        case MOCAP_KIND_INERTIAL_SAMPLE:
        case MOCAP_KIND_INERTIAL_SAMPLE_FINE:
        case MOCAP_KIND_FUSED_SAMPLE:
        case MOCAP_KIND_LIGHT_SAMPLE:
        case MOCAP_KIND_RELAY_BATCH:
            return 3u;
        case MOCAP_KIND_EVENT:
            return 5u;
        case MOCAP_KIND_DEVICE_INFO:
        case MOCAP_KIND_HEALTH:
            return 6u;
        default:
            return 7u;
    }
}

/* Whether a header may hold this id: the module that sends, or that the host means. */
static inline bool mocap_is_module_allowed(uint8_t kind, uint8_t module) {
    if (module <= MOCAP_MAX_MODULE || module == MOCAP_RELAY) {
        return true;
    }
    return module == MOCAP_BROADCAST && (kind == MOCAP_KIND_SYNC_REQUEST || kind ==
            MOCAP_KIND_SAMPLING_TRIGGER || kind == MOCAP_KIND_COMMAND || kind ==
            MOCAP_KIND_TRANSFER_TO_MODULE);
}

/* ---- Bytes, least significant first ------------------------------------------------------------ */

static inline uint8_t *mocap_put_u8(uint8_t *p, uint8_t v) {
    p[0] = v;
    return p + 1;
}

static inline uint8_t *mocap_put_u16(uint8_t *p, uint16_t v) {
    p[0] = (uint8_t)(v & 0xFFu);
    p[1] = (uint8_t)(v >> 8);
    return p + 2;
}

static inline uint8_t *mocap_put_u32(uint8_t *p, uint32_t v) {
    return mocap_put_u16(mocap_put_u16(p, (uint16_t)(v & 0xFFFFu)), (uint16_t)(v >> 16));
}

static inline uint8_t *mocap_put_u64(uint8_t *p, uint64_t v) {
    return mocap_put_u32(mocap_put_u32(p, (uint32_t)(v & 0xFFFFFFFFu)), (uint32_t)(v >> 32));
}

static inline uint8_t *mocap_put_i8(uint8_t *p, int8_t v) { return mocap_put_u8(p, (uint8_t)v); }
static inline uint8_t *mocap_put_i16(uint8_t *p, int16_t v) { return mocap_put_u16(p, (uint16_t)v); }
static inline uint8_t *mocap_put_i32(uint8_t *p, int32_t v) { return mocap_put_u32(p, (uint32_t)v); }

static inline uint8_t *mocap_put_f32(uint8_t *p, float v) {
    uint32_t bits;
    memcpy(&bits, &v, sizeof bits);
    return mocap_put_u32(p, bits);
}

static inline uint8_t *mocap_put_bytes(uint8_t *p, const uint8_t *data, size_t size) {
    if (size > 0u) {
        memmove(p, data, size);
    }
    return p + size;
}

static inline uint8_t mocap_get_u8(const uint8_t *p) { return p[0]; }

static inline uint16_t mocap_get_u16(const uint8_t *p) {
    return (uint16_t)(p[0] | (uint16_t)p[1] << 8);
}

static inline uint32_t mocap_get_u32(const uint8_t *p) {
    return mocap_get_u16(p) | (uint32_t)mocap_get_u16(p + 2) << 16;
}

static inline uint64_t mocap_get_u64(const uint8_t *p) {
    return mocap_get_u32(p) | (uint64_t)mocap_get_u32(p + 4) << 32;
}

/* Two's complement by arithmetic: a plain cast of a large number would be the compiler's choice. */
static inline int8_t mocap_get_i8(const uint8_t *p) {
    return (int8_t)(p[0] < 0x80u ? p[0] : p[0] - 0x100);
}

static inline int16_t mocap_get_i16(const uint8_t *p) {
    const int32_t v = mocap_get_u16(p);
    return (int16_t)(v < 0x8000 ? v : v - 0x10000);
}

static inline int32_t mocap_get_i32(const uint8_t *p) {
    const uint32_t v = mocap_get_u32(p);
    return v < 0x80000000u ? (int32_t)v : -(int32_t)(0xFFFFFFFFu - v) - 1;
}

static inline float mocap_get_f32(const uint8_t *p) {
    const uint32_t bits = mocap_get_u32(p);
    float v;
    memcpy(&v, &bits, sizeof v);
    return v;
}

/* Neither infinite nor "not a number". By its bits, so that no compiler option can reason it away. */
static inline bool mocap_is_finite(float v) {
    uint32_t bits;
    memcpy(&bits, &v, sizeof bits);
    return (bits & 0x7F800000u) != 0x7F800000u;
}

/* Nearest integer in [low, high]; halves away from zero, "not a number" to low. */
static inline int32_t mocap_nearest_signed(MOCAP_REAL v, int32_t low, int32_t high) {
    int32_t whole;
    MOCAP_REAL rest;
    if (!(v > (MOCAP_REAL)low)) {
        return low;
    }
    if (!(v < (MOCAP_REAL)high)) {
        return high;
    }
    whole = (int32_t)v;
    rest = v - (MOCAP_REAL)whole;
    return rest >= (MOCAP_REAL)0.5 ? whole + 1 : rest <= (MOCAP_REAL)-0.5 ? whole - 1 : whole;
}

static inline uint32_t mocap_nearest_unsigned(MOCAP_REAL v, uint32_t low, uint32_t high) {
    uint32_t whole;
    if (!(v > (MOCAP_REAL)low)) {
        return low;
    }
    if (!(v < (MOCAP_REAL)high)) {
        return high;
    }
    whole = (uint32_t)v;
    return v - (MOCAP_REAL)whole >= (MOCAP_REAL)0.5 ? whole + 1u : whole;
}

/* CRC-32 of ISO-HDLC (zlib's). Start from 0; the crc so far continues over the next bytes. */
static inline uint32_t mocap_crc32(uint32_t crc, const uint8_t *data, size_t size) {
#ifdef MOCAP_CRC_BITWISE
    size_t i;
    int bit;
    crc = ~crc;
    for (i = 0; i < size; ++i) {
        crc ^= data[i];
        for (bit = 0; bit < 8; ++bit) {
            crc = crc & 1u ? crc >> 1 ^ 0xEDB88320u : crc >> 1;
        }
    }
    return ~crc;
#else
    static const uint32_t table[16] = {
        0x00000000u, 0x1DB71064u, 0x3B6E20C8u, 0x26D930ACu,
        0x76DC4190u, 0x6B6B51F4u, 0x4DB26158u, 0x5005713Cu,
        0xEDB88320u, 0xF00F9344u, 0xD6D6A3E8u, 0xCB61B38Cu,
        0x9B64C2B0u, 0x86D3D2D4u, 0xA00AE278u, 0xBDBDF21Cu,
    };
    size_t i;
    crc = ~crc;
    for (i = 0; i < size; ++i) {
        crc = crc >> 4 ^ table[(crc ^ data[i]) & 15u];
        crc = crc >> 4 ^ table[(crc ^ (uint32_t)data[i] >> 4) & 15u];
    }
    return ~crc;
#endif
}

/* ---- Text -------------------------------------------------------------------------------------- */

/* Bytes of the UTF-8 character that begins at `p`, of at most `left` bytes; 0 when it is none. */
static inline size_t mocap_character_size(const uint8_t *p, size_t left) {
    const uint8_t first = p[0];
    const size_t size = first < 0x80u ? 1u : first < 0xE0u ? 2u : first < 0xF0u ? 3u : 4u;
    size_t i;
    if (first < 0x80u) {
        return size;
    }
    if (first < 0xC2u || first > 0xF4u || size > left) {
        return 0u;
    }
    for (i = 1u; i < size; ++i) {
        if ((p[i] & 0xC0u) != 0x80u) {
            return 0u;
        }
    }
    /* Spelt longer than need be; half of a surrogate pair; beyond the last character. */
    if ((first == 0xE0u && p[1] < 0xA0u) || (first == 0xEDu && p[1] > 0x9Fu) ||
        (first == 0xF0u && p[1] < 0x90u) || (first == 0xF4u && p[1] > 0x8Fu)) {
        return 0u;
    }
    return size;
}

/* Whether bytes are UTF-8 without a zero. */
static inline bool mocap_is_text(const uint8_t *data, size_t size) {
    size_t at = 0u;
    while (at < size) {
        const size_t step = data[at] == 0u ? 0u : mocap_character_size(data + at, size - at);
        if (step == 0u) {
            return false;
        }
        at += step;
    }
    return true;
}

/* Whether bytes are UTF-8 with nothing but zeros after its end. */
static inline bool mocap_is_padded_text(const uint8_t *data, size_t size) {
    while (size > 0u && data[size - 1u] == 0u) {
        --size;
    }
    return mocap_is_text(data, size);
}

/* ---- Wire frames on a byte stream --------------------------------------------------------------- */

/* Checked bytes with their header. */
typedef struct {
    uint8_t version; /* MOCAP_PROTOCOL_VERSION */
    uint8_t kind;
    uint8_t module; /* sender; from the host: whom it is for */
    uint16_t sequence;
    uint32_t module_time_us;
    const uint8_t *body;
    size_t body_size;
} mocap_wire_frame;

/* Most bytes that a wire frame with this body takes on a byte stream, delimiter included. */
#define MOCAP_SENT_SIZE(body_size) \
    ((body_size) + MOCAP_MIN_FRAME_SIZE + ((body_size) + MOCAP_MIN_FRAME_SIZE) / 254u + 2u)

static inline void mocap_put_header(const mocap_wire_frame *frame, uint8_t header[MOCAP_HEADER_SIZE]) {
    uint8_t *p = header;
    p = mocap_put_u8(p, frame->version);
    p = mocap_put_u8(p, frame->kind);
    p = mocap_put_u8(p, frame->module);
    p = mocap_put_u16(p, frame->sequence);
    (void)mocap_put_u32(p, frame->module_time_us);
}

/* Bytes on their way through COBS: `code_at` is where the count of the group in work will go. */
typedef struct {
    uint8_t *out;
    size_t size;
    size_t code_at;
    uint8_t code;
} mocap_stuffer;

static inline void mocap_stuff_begin(mocap_stuffer *stuffer, uint8_t *out) {
    stuffer->out = out;
    stuffer->code_at = 0u;
    stuffer->size = 1u;
    stuffer->code = 1u;
}

static inline void mocap_stuff_close_group(mocap_stuffer *stuffer) {
    stuffer->out[stuffer->code_at] = stuffer->code;
    stuffer->code_at = stuffer->size++;
    stuffer->code = 1u;
}

static inline void mocap_stuff(mocap_stuffer *stuffer, const uint8_t *data, size_t size) {
    size_t i;
    for (i = 0; i < size; ++i) {
        if (stuffer->code == 0xFFu) { /* full, and more follows */
            mocap_stuff_close_group(stuffer);
        }
        if (data[i] == 0u) {
            mocap_stuff_close_group(stuffer);
        } else {
            stuffer->out[stuffer->size++] = data[i];
            ++stuffer->code;
        }
    }
}

/* Ends the wire frame with its delimiter; returns the bytes written. */
static inline size_t mocap_stuff_end(mocap_stuffer *stuffer) {
    stuffer->out[stuffer->code_at] = stuffer->code;
    stuffer->out[stuffer->size++] = MOCAP_DELIMITER;
    return stuffer->size;
}

/* Undoes COBS in place. False when the bytes are no COBS encoding. */
static inline bool mocap_unstuff(uint8_t *data, size_t size, size_t *unstuffed) {
    size_t from = 0u, to = 0u;
    while (from < size) {
        const uint8_t code = data[from++];
        if (code == 0u || (size_t)(code - 1u) > size - from) {
            return false;
        }
        memmove(data + to, data + from, (size_t)(code - 1u));
        from += (size_t)(code - 1u);
        to += (size_t)(code - 1u);
        if (code < 0xFFu && from < size) {
            data[to++] = 0u;
        }
    }
    *unstuffed = to;
    return true;
}

/* The wire frame as sent on a byte stream, stuffed and ended by the delimiter.
 * `out` must hold MOCAP_SENT_SIZE(frame->body_size) bytes. */
static inline size_t mocap_encode_frame(const mocap_wire_frame *frame, uint8_t *out, size_t capacity) {
    uint8_t header[MOCAP_HEADER_SIZE];
    uint8_t checksum[4];
    mocap_stuffer stuffer;
    if (frame->body_size > MOCAP_MAX_BODY_SIZE || capacity < MOCAP_SENT_SIZE(frame->body_size)) {
        return 0u;
    }
    mocap_put_header(frame, header);
    (void)mocap_put_u32(checksum, mocap_crc32(mocap_crc32(0u, header, sizeof header), frame->body,
            frame->body_size));
    mocap_stuff_begin(&stuffer, out);
    mocap_stuff(&stuffer, header, sizeof header);
    mocap_stuff(&stuffer, frame->body, frame->body_size);
    mocap_stuff(&stuffer, checksum, sizeof checksum);
    return mocap_stuff_end(&stuffer);
}

/* A wire frame from its bytes before stuffing; its body points into them. */
static inline mocap_defect mocap_parse_frame(const uint8_t *raw, size_t size, mocap_wire_frame *frame) {
    if (size < MOCAP_MIN_FRAME_SIZE) {
        return MOCAP_TOO_SHORT;
    }
    if (mocap_get_u32(raw + size - 4u) != mocap_crc32(0u, raw, size - 4u)) {
        return MOCAP_BAD_CRC;
    }
    if (raw[0] != MOCAP_PROTOCOL_VERSION) {
        return MOCAP_BAD_VERSION;
    }
    frame->version = raw[0];
    frame->kind = raw[1];
    frame->module = raw[2];
    frame->sequence = mocap_get_u16(raw + 3);
    frame->module_time_us = mocap_get_u32(raw + 5);
    frame->body = raw + MOCAP_HEADER_SIZE;
    frame->body_size = size - MOCAP_MIN_FRAME_SIZE;
    return MOCAP_GOOD;
}

/* Reassembles wire frames from single bytes; whole again at the delimiter after any damage. */
typedef struct {
    uint8_t *buffer;
    size_t capacity;
    size_t size;
    bool skipping; /* the rest of an overlong wire frame, which has been counted */
    uint32_t accepted;
    uint32_t dropped[MOCAP_DEFECTS]; /* by mocap_defect */
} mocap_frame_decoder;

/* `buffer` bounds the wire frames that can be received: MOCAP_MAX_STUFFED_SIZE bytes for any, less
 * where only short ones are of interest (a longer one then counts as MOCAP_OVERLONG). */
static inline void mocap_frame_decoder_init(mocap_frame_decoder *decoder, uint8_t *buffer, size_t capacity) {
    memset(decoder, 0, sizeof *decoder);
    decoder->buffer = buffer;
    decoder->capacity = capacity < MOCAP_MAX_STUFFED_SIZE ? capacity : MOCAP_MAX_STUFFED_SIZE;
}

static inline bool mocap_frame_decoder_end(mocap_frame_decoder *decoder, mocap_wire_frame *frame) {
    const size_t stuffed = decoder->size;
    const bool skipping = decoder->skipping;
    size_t size = 0u;
    mocap_defect defect = MOCAP_BAD_STUFFING;
    decoder->size = 0u;
    decoder->skipping = false;
    if (skipping || stuffed == 0u) {
        return false;
    }
    if (mocap_unstuff(decoder->buffer, stuffed, &size)) {
        defect = mocap_parse_frame(decoder->buffer, size, frame);
    }
    if (defect != MOCAP_GOOD) {
        ++decoder->dropped[defect];
        return false;
    }
    ++decoder->accepted;
    return true;
}

/* True when this byte completes a wire frame; its body is good until the next push. */
static inline bool mocap_frame_decoder_push(mocap_frame_decoder *decoder, uint8_t byte,
        mocap_wire_frame *frame) {
    if (byte == MOCAP_DELIMITER) {
        return mocap_frame_decoder_end(decoder, frame);
    }
    if (decoder->skipping) {
        return false;
    }
    if (decoder->size == decoder->capacity) {
        ++decoder->dropped[MOCAP_OVERLONG];
        decoder->skipping = true;
        return false;
    }
    decoder->buffer[decoder->size++] = byte;
    return false;
}

/* ---- Signed wire frames ------------------------------------------------------------------------- */

#define MOCAP_LARGEST_COUNT 0xFFFFFFFFFFFFull /* 48 bits */

/* Keyed BLAKE2s (RFC 7693) with a digest of MOCAP_TAG_SIZE bytes. */
typedef struct {
    uint32_t state[8];
    uint32_t length; /* bytes taken, the block of the key among them */
    uint8_t block[64];
    uint8_t filled; /* bytes in the block that are not yet in the state */
} mocap_blake2s;

static inline uint32_t mocap_rotate_right(uint32_t v, unsigned bits) {
    return v >> bits | v << (32u - bits);
}

static inline void mocap_blake2s_mix(uint32_t v[16], const uint8_t *places, uint32_t x, uint32_t y) {
    uint32_t a = v[places[0]], b = v[places[1]], c = v[places[2]], d = v[places[3]];
    a += b + x;
    d = mocap_rotate_right(d ^ a, 16u);
    c += d;
    b = mocap_rotate_right(b ^ c, 12u);
    a += b + y;
    d = mocap_rotate_right(d ^ a, 8u);
    c += d;
    b = mocap_rotate_right(b ^ c, 7u);
    v[places[0]] = a;
    v[places[1]] = b;
    v[places[2]] = c;
    v[places[3]] = d;
}

static inline uint32_t mocap_blake2s_start(unsigned word) {
    static const uint32_t start[8] = {
        0x6A09E667u, 0xBB67AE85u, 0x3C6EF372u, 0xA54FF53Au,
        0x510E527Fu, 0x9B05688Cu, 0x1F83D9ABu, 0x5BE0CD19u,
    };
    return start[word];
}

static inline void mocap_blake2s_compress(mocap_blake2s *hash, bool is_last) {
    static const uint8_t places[8][4] = {
        {0, 4, 8, 12}, {1, 5, 9, 13}, {2, 6, 10, 14}, {3, 7, 11, 15},
        {0, 5, 10, 15}, {1, 6, 11, 12}, {2, 7, 8, 13}, {3, 4, 9, 14},
    };
    static const uint8_t order[10][16] = {
        {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15},
        {14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3},
        {11, 8, 12, 0, 5, 2, 15, 13, 10, 14, 3, 6, 7, 1, 9, 4},
        {7, 9, 3, 1, 13, 12, 11, 14, 2, 6, 5, 10, 4, 0, 15, 8},
        {9, 0, 5, 7, 2, 4, 10, 15, 14, 1, 11, 12, 6, 8, 3, 13},
        {2, 12, 6, 10, 0, 11, 8, 3, 4, 13, 7, 5, 15, 14, 1, 9},
        {12, 5, 1, 15, 14, 13, 4, 10, 0, 7, 6, 3, 9, 2, 8, 11},
        {13, 11, 7, 14, 12, 1, 3, 9, 5, 0, 15, 4, 8, 6, 2, 10},
        {6, 15, 14, 9, 11, 3, 0, 8, 12, 2, 13, 7, 1, 4, 10, 5},
        {10, 2, 8, 4, 7, 6, 1, 5, 15, 11, 9, 14, 3, 12, 13, 0},
    };
    uint32_t v[16], words[16];
    unsigned i, round;
    for (i = 0u; i < 16u; ++i) {
        words[i] = mocap_get_u32(hash->block + 4u * i);
        v[i] = i < 8u ? hash->state[i] : mocap_blake2s_start(i - 8u);
    }
    v[12] ^= hash->length; /* a wire frame is far from 2^32 bytes */
    if (is_last) {
        v[14] = ~v[14];
    }
    for (round = 0u; round < 10u; ++round) {
        for (i = 0u; i < 8u; ++i) {
            mocap_blake2s_mix(v, places[i], words[order[round][2u * i]], words[order[round][2u * i + 1u]]);
        }
    }
    for (i = 0u; i < 8u; ++i) {
        hash->state[i] ^= v[i] ^ v[i + 8u];
    }
    hash->filled = 0u;
}

/* The last block waits until it is known that it is the last one. */
static inline void mocap_blake2s_put(mocap_blake2s *hash, const uint8_t *data, size_t size) {
    size_t i;
    for (i = 0u; i < size; ++i) {
        if (hash->filled == 64u) {
            mocap_blake2s_compress(hash, false);
        }
        hash->block[hash->filled++] = data[i];
        ++hash->length;
    }
}

static inline void mocap_blake2s_begin(mocap_blake2s *hash, const uint8_t key[MOCAP_KEY_SIZE]) {
    unsigned i;
    for (i = 0u; i < 8u; ++i) {
        hash->state[i] = mocap_blake2s_start(i);
    }
    hash->state[0] ^= 0x01010000u | MOCAP_KEY_SIZE << 8 | MOCAP_TAG_SIZE;
    memset(hash->block, 0, sizeof hash->block);
    memcpy(hash->block, key, MOCAP_KEY_SIZE);
    hash->length = hash->filled = 64u;
}

static inline void mocap_blake2s_end(mocap_blake2s *hash, uint8_t tag[MOCAP_TAG_SIZE]) {
    uint8_t words[8];
    memset(hash->block + hash->filled, 0, sizeof hash->block - hash->filled);
    mocap_blake2s_compress(hash, true);
    (void)mocap_put_u32(mocap_put_u32(words, hash->state[0]), hash->state[1]);
    memcpy(tag, words, MOCAP_TAG_SIZE);
}

/* A module's end of a signed link: its key, what it has counted, and what the host has. */
typedef struct {
    uint8_t key[MOCAP_KEY_SIZE];
    uint32_t signer;
    uint64_t count;       /* newest that was signed, or heard where that was higher */
    uint64_t host_newest; /* store it before a command is obeyed, and begin with it after a restart */
    uint64_t host_oldest; /* nothing up to this is taken */
    uint64_t host_seen;   /* of the 64 counts up to the newest those that came, the newest lowest */
} mocap_signing;

/* signer: CRC-32 of the unique id, never MOCAP_HOST_SIGNER. count: `host_newest` as stored; else 0. */
static inline void mocap_signing_begin(mocap_signing *signing, const uint8_t key[MOCAP_KEY_SIZE],
        uint32_t signer, uint64_t count) {
    memset(signing, 0, sizeof *signing);
    memcpy(signing->key, key, MOCAP_KEY_SIZE);
    signing->signer = signer;
    signing->count = signing->host_newest = signing->host_oldest = count;
}

/* Begins the tag with what of a signature is signed: all before the tag itself. */
static inline void mocap_signing_hash(const mocap_signing *signing, mocap_blake2s *hash,
        const uint8_t signature[MOCAP_SIGNATURE_SIZE]) {
    mocap_blake2s_begin(hash, signing->key);
    mocap_blake2s_put(hash, signature, MOCAP_SIGNATURE_SIZE - MOCAP_TAG_SIZE);
}

/* Signs a wire frame as mocap_encode_frame() made it. Send the signature first, then the wire frame;
 * both in one datagram. Returns MOCAP_SENT_SIGNATURE_SIZE, or 0 when the key has been used up. */
static inline size_t mocap_sign(mocap_signing *signing, const uint8_t *sent, size_t size,
        uint8_t signature[MOCAP_SENT_SIGNATURE_SIZE]) {
    uint8_t raw[MOCAP_SIGNATURE_SIZE];
    uint8_t *p = mocap_put_u32(mocap_put_u8(raw, MOCAP_SIGNATURE_MARK), signing->signer);
    mocap_blake2s hash;
    mocap_stuffer stuffer;
    if (signing->count >= MOCAP_LARGEST_COUNT) {
        return 0u;
    }
    ++signing->count;
    p = mocap_put_u32(p, (uint32_t)(signing->count & 0xFFFFFFFFu));
    p = mocap_put_u16(p, (uint16_t)(signing->count >> 32));
    mocap_signing_hash(signing, &hash, raw);
    mocap_blake2s_put(&hash, sent, size);
    mocap_blake2s_end(&hash, p);
    mocap_stuff_begin(&stuffer, signature);
    mocap_stuff(&stuffer, raw, sizeof raw);
    return mocap_stuff_end(&stuffer);
}

/* Whether a count of the host's, rightly signed, is new. */
static inline mocap_defect mocap_signing_note(mocap_signing *signing, uint64_t count) {
    if (count > signing->host_newest) {
        const uint64_t ahead = count - signing->host_newest;
        signing->host_seen = (ahead < 64u ? signing->host_seen << ahead : 0u) | 1u;
        signing->host_newest = count;
        signing->count = signing->count > count ? signing->count : count;
        return MOCAP_GOOD;
    }
    if (count <= signing->host_oldest || signing->host_newest - count >= 64u) {
        return MOCAP_OUTDATED;
    }
    if ((signing->host_seen >> (signing->host_newest - count) & 1u) != 0u) {
        return MOCAP_REPLAYED;
    }
    signing->host_seen |= (uint64_t)1u << (signing->host_newest - count);
    return MOCAP_GOOD;
}

/* Takes signed wire frames of the host from single bytes; all else is dropped and counted. */
typedef struct {
    mocap_frame_decoder frames; /* its `accepted` and `dropped` count for both */
    mocap_signing *signing;
    mocap_blake2s hash; /* of the signature and of the wire frame so far */
    uint8_t signature[MOCAP_SIGNATURE_SIZE];
    bool has_signature;
} mocap_signed_decoder;

/* `buffer` as for mocap_frame_decoder_init(). */
static inline void mocap_signed_decoder_init(mocap_signed_decoder *decoder, mocap_signing *signing,
        uint8_t *buffer, size_t capacity) {
    memset(decoder, 0, sizeof *decoder);
    mocap_frame_decoder_init(&decoder->frames, buffer, capacity);
    decoder->signing = signing;
}

/* Why a whole wire frame is not to be believed; MOCAP_GOOD if it is. */
static inline mocap_defect mocap_signed_decoder_verify(mocap_signed_decoder *decoder) {
    const uint8_t delimiter = MOCAP_DELIMITER;
    const uint8_t *p = decoder->signature + MOCAP_SIGNATURE_SIZE - MOCAP_TAG_SIZE;
    uint8_t tag[MOCAP_TAG_SIZE], wrong = 0u;
    size_t i;
    mocap_blake2s_put(&decoder->hash, &delimiter, 1u);
    mocap_blake2s_end(&decoder->hash, tag);
    for (i = 0u; i < MOCAP_TAG_SIZE; ++i) { /* as long for a wrong tag as for a right one */
        wrong |= (uint8_t)(tag[i] ^ p[i]);
    }
    if (wrong != 0u || mocap_get_u32(decoder->signature + 1) != MOCAP_HOST_SIGNER) {
        return MOCAP_BAD_SIGNATURE;
    }
    return mocap_signing_note(decoder->signing,
            mocap_get_u32(decoder->signature + 5) | (uint64_t)mocap_get_u16(decoder->signature + 9) << 32);
}

/* Takes the bytes before a delimiter for a signature, if they are one. */
static inline bool mocap_signed_decoder_take(mocap_signed_decoder *decoder) {
    uint8_t *bytes = decoder->frames.buffer;
    size_t size = decoder->frames.size;
    decoder->frames.size = 0u;
    decoder->has_signature = size == MOCAP_SENT_SIGNATURE_SIZE - 1u && mocap_unstuff(bytes, size, &size)
            && size == MOCAP_SIGNATURE_SIZE && bytes[0] == MOCAP_SIGNATURE_MARK;
    if (decoder->has_signature) {
        memcpy(decoder->signature, bytes, MOCAP_SIGNATURE_SIZE);
        mocap_signing_hash(decoder->signing, &decoder->hash, decoder->signature);
    }
    return decoder->has_signature;
}

static inline bool mocap_signed_decoder_end(mocap_signed_decoder *decoder, mocap_wire_frame *frame) {
    mocap_defect defect = MOCAP_UNSIGNED;
    if (decoder->frames.skipping) { /* overlong, and counted */
        decoder->has_signature = false;
        return mocap_frame_decoder_end(&decoder->frames, frame);
    }
    if (decoder->has_signature) {
        decoder->has_signature = false;
        defect = mocap_signed_decoder_verify(decoder);
        if (defect == MOCAP_GOOD) {
            return mocap_frame_decoder_end(&decoder->frames, frame);
        }
        (void)mocap_signed_decoder_take(decoder); /* the wire frame of the one before was lost */
    } else if (decoder->frames.size == 0u || mocap_signed_decoder_take(decoder)) {
        return false;
    }
    ++decoder->frames.dropped[defect];
    return false;
}

/* True when this byte completes a rightly signed wire frame; its body is good until the next push. */
static inline bool mocap_signed_decoder_push(mocap_signed_decoder *decoder, uint8_t byte,
        mocap_wire_frame *frame) {
    if (byte == MOCAP_DELIMITER) {
        return mocap_signed_decoder_end(decoder, frame);
    }
    if (decoder->has_signature) {
        mocap_blake2s_put(&decoder->hash, &byte, 1u);
    }
    return mocap_frame_decoder_push(&decoder->frames, byte, frame);
}

/* ---- Packets: the bodies of wire frames ---------------------------------------------------------- */

#define MOCAP_INERTIAL_SAMPLE_HAS_SPECIFIC_FORCE 0x01u
#define MOCAP_INERTIAL_SAMPLE_HAS_MAGNETIC_FIELD 0x02u
#define MOCAP_INERTIAL_SAMPLE_HAS_ANGULAR_RATE 0x04u
/* An axis of the accelerometer is at the end of its range. */
#define MOCAP_INERTIAL_SAMPLE_SPECIFIC_FORCE_CLIPPED 0x10u
/* An axis of the magnetometer is at the end of its range. */
#define MOCAP_INERTIAL_SAMPLE_MAGNETIC_FIELD_CLIPPED 0x20u
/* An axis of the gyroscope is at the end of its range. */
#define MOCAP_INERTIAL_SAMPLE_ANGULAR_RATE_CLIPPED 0x40u
/* Sampled on a trigger of the host, not on the module's own timer. */
#define MOCAP_INERTIAL_SAMPLE_TRIGGERED 0x80u
#define MOCAP_INERTIAL_SAMPLE_MIN_SIZE 1u
#define MOCAP_INERTIAL_SAMPLE_MAX_SIZE 19u

/* 0x10. One reading of a module's inertial sensors, for streaming. */
typedef struct {
    uint8_t mask; /* which fields are present, and flags */
    /* Specific force; at rest it reads 9.81 m/s^2 on the axis that points up. One step is
     * 0.00478840332 m/s^2. */
    int16_t specific_force[3];
    /* Magnetic field. One step is 0.05 uT. */
    int16_t magnetic_field[3];
    /* Angular rate. One step is 0.00106526444 rad/s. */
    int16_t angular_rate[3];
} mocap_inertial_sample;

/* Bytes that a mask demands; 0 for one that must not be used. */
static inline size_t mocap_inertial_sample_size(uint8_t mask) {
    size_t size = 1u;
    if ((mask & 0x08u) != 0u || ((mask & MOCAP_INERTIAL_SAMPLE_SPECIFIC_FORCE_CLIPPED) != 0u && (mask &
            MOCAP_INERTIAL_SAMPLE_HAS_SPECIFIC_FORCE) == 0u) || ((mask &
            MOCAP_INERTIAL_SAMPLE_MAGNETIC_FIELD_CLIPPED) != 0u && (mask &
            MOCAP_INERTIAL_SAMPLE_HAS_MAGNETIC_FIELD) == 0u) || ((mask &
            MOCAP_INERTIAL_SAMPLE_ANGULAR_RATE_CLIPPED) != 0u && (mask &
            MOCAP_INERTIAL_SAMPLE_HAS_ANGULAR_RATE) == 0u)) {
        return 0u;
    }
    size += (mask & MOCAP_INERTIAL_SAMPLE_HAS_SPECIFIC_FORCE) != 0u ? 6u : 0u;
    size += (mask & MOCAP_INERTIAL_SAMPLE_HAS_MAGNETIC_FIELD) != 0u ? 6u : 0u;
    size += (mask & MOCAP_INERTIAL_SAMPLE_HAS_ANGULAR_RATE) != 0u ? 6u : 0u;
    return size;
}

static inline size_t mocap_encode_inertial_sample(const mocap_inertial_sample *packet, uint8_t *body, size_t
        capacity) {
    const size_t size = mocap_inertial_sample_size(packet->mask);
    uint8_t *p = body;
    size_t i;
    if (size == 0u || size > capacity) {
        return 0u;
    }
    p = mocap_put_u8(p, packet->mask);
    if ((packet->mask & MOCAP_INERTIAL_SAMPLE_HAS_SPECIFIC_FORCE) != 0u) {
        for (i = 0; i < 3u; ++i) {
            p = mocap_put_i16(p, packet->specific_force[i]);
        }
    }
    if ((packet->mask & MOCAP_INERTIAL_SAMPLE_HAS_MAGNETIC_FIELD) != 0u) {
        for (i = 0; i < 3u; ++i) {
            p = mocap_put_i16(p, packet->magnetic_field[i]);
        }
    }
    if ((packet->mask & MOCAP_INERTIAL_SAMPLE_HAS_ANGULAR_RATE) != 0u) {
        for (i = 0; i < 3u; ++i) {
            p = mocap_put_i16(p, packet->angular_rate[i]);
        }
    }
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_inertial_sample(const uint8_t *body, size_t size,
        mocap_inertial_sample *packet) {
    const uint8_t *p = body;
    size_t i;
    if (size == 0u) {
        return MOCAP_BAD_LENGTH;
    }
    if (mocap_inertial_sample_size(body[0]) == 0u) {
        return MOCAP_BAD_VALUE;
    }
    if (size != mocap_inertial_sample_size(body[0])) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->mask = *p++;
    if ((packet->mask & MOCAP_INERTIAL_SAMPLE_HAS_SPECIFIC_FORCE) != 0u) {
        for (i = 0; i < 3u; ++i) {
            packet->specific_force[i] = mocap_get_i16(p);
            p += 2u;
        }
    }
    if ((packet->mask & MOCAP_INERTIAL_SAMPLE_HAS_MAGNETIC_FIELD) != 0u) {
        for (i = 0; i < 3u; ++i) {
            packet->magnetic_field[i] = mocap_get_i16(p);
            p += 2u;
        }
    }
    if ((packet->mask & MOCAP_INERTIAL_SAMPLE_HAS_ANGULAR_RATE) != 0u) {
        for (i = 0; i < 3u; ++i) {
            packet->angular_rate[i] = mocap_get_i16(p);
            p += 2u;
        }
    }
    (void)p;
    return MOCAP_GOOD;
}

/* Between steps and m/s^2; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_inertial_sample_specific_force_to_si(int16_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)0.0047884033203125;
}

static inline int16_t mocap_inertial_sample_specific_force_from_si(MOCAP_REAL value) {
    return (int16_t)mocap_nearest_signed(value / (MOCAP_REAL)0.0047884033203125, -32767, 32767);
}

/* Puts a reading into a sample, in steps or in m/s^2; beyond the range as its end, clipped. */
static inline void mocap_inertial_sample_set_specific_force(mocap_inertial_sample *packet, int32_t x, int32_t
        y, int32_t z) {
    const int32_t v[3] = {x, y, z};
    size_t i;
    packet->mask = (uint8_t)((packet->mask | MOCAP_INERTIAL_SAMPLE_HAS_SPECIFIC_FORCE) & (0xFFu ^
            MOCAP_INERTIAL_SAMPLE_SPECIFIC_FORCE_CLIPPED));
    for (i = 0; i < 3u; ++i) {
        if (v[i] < -32767 || v[i] > 32767) {
            packet->mask = (uint8_t)(packet->mask | MOCAP_INERTIAL_SAMPLE_SPECIFIC_FORCE_CLIPPED);
            packet->specific_force[i] = (int16_t)(v[i] < 0 ? -32767 : 32767);
        } else {
            packet->specific_force[i] = (int16_t)v[i];
        }
    }
}

static inline void mocap_inertial_sample_set_specific_force_si(mocap_inertial_sample *packet, MOCAP_REAL x,
        MOCAP_REAL y, MOCAP_REAL z) {
    const MOCAP_REAL v[3] = {x / (MOCAP_REAL)0.0047884033203125, y / (MOCAP_REAL)0.0047884033203125, z /
            (MOCAP_REAL)0.0047884033203125};
    size_t i;
    packet->mask = (uint8_t)((packet->mask | MOCAP_INERTIAL_SAMPLE_HAS_SPECIFIC_FORCE) & (0xFFu ^
            MOCAP_INERTIAL_SAMPLE_SPECIFIC_FORCE_CLIPPED));
    for (i = 0; i < 3u; ++i) {
        if (!(v[i] > (MOCAP_REAL)-32767.5 && v[i] < (MOCAP_REAL)32767.5)) {
            packet->mask = (uint8_t)(packet->mask | MOCAP_INERTIAL_SAMPLE_SPECIFIC_FORCE_CLIPPED);
            packet->specific_force[i] = (int16_t)(v[i] < 0 ? -32767 : 32767);
        } else {
            packet->specific_force[i] = (int16_t)mocap_nearest_signed(v[i], -32767, 32767);
        }
    }
}

/* Between steps and uT; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_inertial_sample_magnetic_field_to_si(int16_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)0.05;
}

static inline int16_t mocap_inertial_sample_magnetic_field_from_si(MOCAP_REAL value) {
    return (int16_t)mocap_nearest_signed(value / (MOCAP_REAL)0.05, -32767, 32767);
}

/* Puts a reading into a sample, in steps or in uT; beyond the range as its end, clipped. */
static inline void mocap_inertial_sample_set_magnetic_field(mocap_inertial_sample *packet, int32_t x, int32_t
        y, int32_t z) {
    const int32_t v[3] = {x, y, z};
    size_t i;
    packet->mask = (uint8_t)((packet->mask | MOCAP_INERTIAL_SAMPLE_HAS_MAGNETIC_FIELD) & (0xFFu ^
            MOCAP_INERTIAL_SAMPLE_MAGNETIC_FIELD_CLIPPED));
    for (i = 0; i < 3u; ++i) {
        if (v[i] < -32767 || v[i] > 32767) {
            packet->mask = (uint8_t)(packet->mask | MOCAP_INERTIAL_SAMPLE_MAGNETIC_FIELD_CLIPPED);
            packet->magnetic_field[i] = (int16_t)(v[i] < 0 ? -32767 : 32767);
        } else {
            packet->magnetic_field[i] = (int16_t)v[i];
        }
    }
}

static inline void mocap_inertial_sample_set_magnetic_field_si(mocap_inertial_sample *packet, MOCAP_REAL x,
        MOCAP_REAL y, MOCAP_REAL z) {
    const MOCAP_REAL v[3] = {x / (MOCAP_REAL)0.05, y / (MOCAP_REAL)0.05, z / (MOCAP_REAL)0.05};
    size_t i;
    packet->mask = (uint8_t)((packet->mask | MOCAP_INERTIAL_SAMPLE_HAS_MAGNETIC_FIELD) & (0xFFu ^
            MOCAP_INERTIAL_SAMPLE_MAGNETIC_FIELD_CLIPPED));
    for (i = 0; i < 3u; ++i) {
        if (!(v[i] > (MOCAP_REAL)-32767.5 && v[i] < (MOCAP_REAL)32767.5)) {
            packet->mask = (uint8_t)(packet->mask | MOCAP_INERTIAL_SAMPLE_MAGNETIC_FIELD_CLIPPED);
            packet->magnetic_field[i] = (int16_t)(v[i] < 0 ? -32767 : 32767);
        } else {
            packet->magnetic_field[i] = (int16_t)mocap_nearest_signed(v[i], -32767, 32767);
        }
    }
}

/* Between steps and rad/s; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_inertial_sample_angular_rate_to_si(int16_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)0.0010652644360316954;
}

static inline int16_t mocap_inertial_sample_angular_rate_from_si(MOCAP_REAL value) {
    return (int16_t)mocap_nearest_signed(value / (MOCAP_REAL)0.0010652644360316954, -32767, 32767);
}

/* Puts a reading into a sample, in steps or in rad/s; beyond the range as its end, clipped. */
static inline void mocap_inertial_sample_set_angular_rate(mocap_inertial_sample *packet, int32_t x, int32_t y,
        int32_t z) {
    const int32_t v[3] = {x, y, z};
    size_t i;
    packet->mask = (uint8_t)((packet->mask | MOCAP_INERTIAL_SAMPLE_HAS_ANGULAR_RATE) & (0xFFu ^
            MOCAP_INERTIAL_SAMPLE_ANGULAR_RATE_CLIPPED));
    for (i = 0; i < 3u; ++i) {
        if (v[i] < -32767 || v[i] > 32767) {
            packet->mask = (uint8_t)(packet->mask | MOCAP_INERTIAL_SAMPLE_ANGULAR_RATE_CLIPPED);
            packet->angular_rate[i] = (int16_t)(v[i] < 0 ? -32767 : 32767);
        } else {
            packet->angular_rate[i] = (int16_t)v[i];
        }
    }
}

static inline void mocap_inertial_sample_set_angular_rate_si(mocap_inertial_sample *packet, MOCAP_REAL x,
        MOCAP_REAL y, MOCAP_REAL z) {
    const MOCAP_REAL v[3] = {x / (MOCAP_REAL)0.0010652644360316954, y / (MOCAP_REAL)0.0010652644360316954, z /
            (MOCAP_REAL)0.0010652644360316954};
    size_t i;
    packet->mask = (uint8_t)((packet->mask | MOCAP_INERTIAL_SAMPLE_HAS_ANGULAR_RATE) & (0xFFu ^
            MOCAP_INERTIAL_SAMPLE_ANGULAR_RATE_CLIPPED));
    for (i = 0; i < 3u; ++i) {
        if (!(v[i] > (MOCAP_REAL)-32767.5 && v[i] < (MOCAP_REAL)32767.5)) {
            packet->mask = (uint8_t)(packet->mask | MOCAP_INERTIAL_SAMPLE_ANGULAR_RATE_CLIPPED);
            packet->angular_rate[i] = (int16_t)(v[i] < 0 ? -32767 : 32767);
        } else {
            packet->angular_rate[i] = (int16_t)mocap_nearest_signed(v[i], -32767, 32767);
        }
    }
}

#define MOCAP_INERTIAL_SAMPLE_FINE_HAS_SPECIFIC_FORCE 0x01u
#define MOCAP_INERTIAL_SAMPLE_FINE_HAS_MAGNETIC_FIELD 0x02u
#define MOCAP_INERTIAL_SAMPLE_FINE_HAS_ANGULAR_RATE 0x04u
/* An axis of the accelerometer is at the end of its range. */
#define MOCAP_INERTIAL_SAMPLE_FINE_SPECIFIC_FORCE_CLIPPED 0x10u
/* An axis of the magnetometer is at the end of its range. */
#define MOCAP_INERTIAL_SAMPLE_FINE_MAGNETIC_FIELD_CLIPPED 0x20u
/* An axis of the gyroscope is at the end of its range. */
#define MOCAP_INERTIAL_SAMPLE_FINE_ANGULAR_RATE_CLIPPED 0x40u
/* Sampled on a trigger of the host, not on the module's own timer. */
#define MOCAP_INERTIAL_SAMPLE_FINE_TRIGGERED 0x80u
#define MOCAP_INERTIAL_SAMPLE_FINE_MIN_SIZE 1u
#define MOCAP_INERTIAL_SAMPLE_FINE_MAX_SIZE 37u

/* 0x11. The same in finer steps, for laboratory modules and for recordings played without loss. */
typedef struct {
    uint8_t mask; /* which fields are present, and flags */
    /* Specific force; at rest it reads 9.81 m/s^2 on the axis that points up. One step is 1e-05
     * m/s^2. */
    int32_t specific_force[3];
    /* Magnetic field. One step is 0.0001 uT. */
    int32_t magnetic_field[3];
    /* Angular rate. One step is 1e-06 rad/s. */
    int32_t angular_rate[3];
} mocap_inertial_sample_fine;

/* Bytes that a mask demands; 0 for one that must not be used. */
static inline size_t mocap_inertial_sample_fine_size(uint8_t mask) {
    size_t size = 1u;
    if ((mask & 0x08u) != 0u || ((mask & MOCAP_INERTIAL_SAMPLE_FINE_SPECIFIC_FORCE_CLIPPED) != 0u && (mask &
            MOCAP_INERTIAL_SAMPLE_FINE_HAS_SPECIFIC_FORCE) == 0u) || ((mask &
            MOCAP_INERTIAL_SAMPLE_FINE_MAGNETIC_FIELD_CLIPPED) != 0u && (mask &
            MOCAP_INERTIAL_SAMPLE_FINE_HAS_MAGNETIC_FIELD) == 0u) || ((mask &
            MOCAP_INERTIAL_SAMPLE_FINE_ANGULAR_RATE_CLIPPED) != 0u && (mask &
            MOCAP_INERTIAL_SAMPLE_FINE_HAS_ANGULAR_RATE) == 0u)) {
        return 0u;
    }
    size += (mask & MOCAP_INERTIAL_SAMPLE_FINE_HAS_SPECIFIC_FORCE) != 0u ? 12u : 0u;
    size += (mask & MOCAP_INERTIAL_SAMPLE_FINE_HAS_MAGNETIC_FIELD) != 0u ? 12u : 0u;
    size += (mask & MOCAP_INERTIAL_SAMPLE_FINE_HAS_ANGULAR_RATE) != 0u ? 12u : 0u;
    return size;
}

static inline size_t mocap_encode_inertial_sample_fine(const mocap_inertial_sample_fine *packet, uint8_t
        *body, size_t capacity) {
    const size_t size = mocap_inertial_sample_fine_size(packet->mask);
    uint8_t *p = body;
    size_t i;
    if (size == 0u || size > capacity) {
        return 0u;
    }
    p = mocap_put_u8(p, packet->mask);
    if ((packet->mask & MOCAP_INERTIAL_SAMPLE_FINE_HAS_SPECIFIC_FORCE) != 0u) {
        for (i = 0; i < 3u; ++i) {
            p = mocap_put_i32(p, packet->specific_force[i]);
        }
    }
    if ((packet->mask & MOCAP_INERTIAL_SAMPLE_FINE_HAS_MAGNETIC_FIELD) != 0u) {
        for (i = 0; i < 3u; ++i) {
            p = mocap_put_i32(p, packet->magnetic_field[i]);
        }
    }
    if ((packet->mask & MOCAP_INERTIAL_SAMPLE_FINE_HAS_ANGULAR_RATE) != 0u) {
        for (i = 0; i < 3u; ++i) {
            p = mocap_put_i32(p, packet->angular_rate[i]);
        }
    }
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_inertial_sample_fine(const uint8_t *body, size_t size,
        mocap_inertial_sample_fine *packet) {
    const uint8_t *p = body;
    size_t i;
    if (size == 0u) {
        return MOCAP_BAD_LENGTH;
    }
    if (mocap_inertial_sample_fine_size(body[0]) == 0u) {
        return MOCAP_BAD_VALUE;
    }
    if (size != mocap_inertial_sample_fine_size(body[0])) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->mask = *p++;
    if ((packet->mask & MOCAP_INERTIAL_SAMPLE_FINE_HAS_SPECIFIC_FORCE) != 0u) {
        for (i = 0; i < 3u; ++i) {
            packet->specific_force[i] = mocap_get_i32(p);
            p += 4u;
        }
    }
    if ((packet->mask & MOCAP_INERTIAL_SAMPLE_FINE_HAS_MAGNETIC_FIELD) != 0u) {
        for (i = 0; i < 3u; ++i) {
            packet->magnetic_field[i] = mocap_get_i32(p);
            p += 4u;
        }
    }
    if ((packet->mask & MOCAP_INERTIAL_SAMPLE_FINE_HAS_ANGULAR_RATE) != 0u) {
        for (i = 0; i < 3u; ++i) {
            packet->angular_rate[i] = mocap_get_i32(p);
            p += 4u;
        }
    }
    (void)p;
    return MOCAP_GOOD;
}

/* Between steps and m/s^2; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_inertial_sample_fine_specific_force_to_si(int32_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)1e-05;
}

static inline int32_t mocap_inertial_sample_fine_specific_force_from_si(MOCAP_REAL value) {
    return (int32_t)mocap_nearest_signed(value / (MOCAP_REAL)1e-05, -2147483647, 2147483647);
}

/* Puts a reading into a sample, in steps or in m/s^2; beyond the range as its end, clipped. */
static inline void mocap_inertial_sample_fine_set_specific_force(mocap_inertial_sample_fine *packet, int32_t
        x, int32_t y, int32_t z) {
    const int32_t v[3] = {x, y, z};
    size_t i;
    packet->mask = (uint8_t)((packet->mask | MOCAP_INERTIAL_SAMPLE_FINE_HAS_SPECIFIC_FORCE) & (0xFFu ^
            MOCAP_INERTIAL_SAMPLE_FINE_SPECIFIC_FORCE_CLIPPED));
    for (i = 0; i < 3u; ++i) {
        if (v[i] < -2147483647) {
            packet->mask = (uint8_t)(packet->mask | MOCAP_INERTIAL_SAMPLE_FINE_SPECIFIC_FORCE_CLIPPED);
            packet->specific_force[i] = (int32_t)(v[i] < 0 ? -2147483647 : 2147483647);
        } else {
            packet->specific_force[i] = (int32_t)v[i];
        }
    }
}

static inline void mocap_inertial_sample_fine_set_specific_force_si(mocap_inertial_sample_fine *packet,
        MOCAP_REAL x, MOCAP_REAL y, MOCAP_REAL z) {
    const MOCAP_REAL v[3] = {x / (MOCAP_REAL)1e-05, y / (MOCAP_REAL)1e-05, z / (MOCAP_REAL)1e-05};
    size_t i;
    packet->mask = (uint8_t)((packet->mask | MOCAP_INERTIAL_SAMPLE_FINE_HAS_SPECIFIC_FORCE) & (0xFFu ^
            MOCAP_INERTIAL_SAMPLE_FINE_SPECIFIC_FORCE_CLIPPED));
    for (i = 0; i < 3u; ++i) {
        if (!(v[i] > (MOCAP_REAL)-2147483647.5 && v[i] < (MOCAP_REAL)2147483647.5)) {
            packet->mask = (uint8_t)(packet->mask | MOCAP_INERTIAL_SAMPLE_FINE_SPECIFIC_FORCE_CLIPPED);
            packet->specific_force[i] = (int32_t)(v[i] < 0 ? -2147483647 : 2147483647);
        } else {
            packet->specific_force[i] = (int32_t)mocap_nearest_signed(v[i], -2147483647, 2147483647);
        }
    }
}

/* Between steps and uT; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_inertial_sample_fine_magnetic_field_to_si(int32_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)0.0001;
}

static inline int32_t mocap_inertial_sample_fine_magnetic_field_from_si(MOCAP_REAL value) {
    return (int32_t)mocap_nearest_signed(value / (MOCAP_REAL)0.0001, -2147483647, 2147483647);
}

/* Puts a reading into a sample, in steps or in uT; beyond the range as its end, clipped. */
static inline void mocap_inertial_sample_fine_set_magnetic_field(mocap_inertial_sample_fine *packet, int32_t
        x, int32_t y, int32_t z) {
    const int32_t v[3] = {x, y, z};
    size_t i;
    packet->mask = (uint8_t)((packet->mask | MOCAP_INERTIAL_SAMPLE_FINE_HAS_MAGNETIC_FIELD) & (0xFFu ^
            MOCAP_INERTIAL_SAMPLE_FINE_MAGNETIC_FIELD_CLIPPED));
    for (i = 0; i < 3u; ++i) {
        if (v[i] < -2147483647) {
            packet->mask = (uint8_t)(packet->mask | MOCAP_INERTIAL_SAMPLE_FINE_MAGNETIC_FIELD_CLIPPED);
            packet->magnetic_field[i] = (int32_t)(v[i] < 0 ? -2147483647 : 2147483647);
        } else {
            packet->magnetic_field[i] = (int32_t)v[i];
        }
    }
}

static inline void mocap_inertial_sample_fine_set_magnetic_field_si(mocap_inertial_sample_fine *packet,
        MOCAP_REAL x, MOCAP_REAL y, MOCAP_REAL z) {
    const MOCAP_REAL v[3] = {x / (MOCAP_REAL)0.0001, y / (MOCAP_REAL)0.0001, z / (MOCAP_REAL)0.0001};
    size_t i;
    packet->mask = (uint8_t)((packet->mask | MOCAP_INERTIAL_SAMPLE_FINE_HAS_MAGNETIC_FIELD) & (0xFFu ^
            MOCAP_INERTIAL_SAMPLE_FINE_MAGNETIC_FIELD_CLIPPED));
    for (i = 0; i < 3u; ++i) {
        if (!(v[i] > (MOCAP_REAL)-2147483647.5 && v[i] < (MOCAP_REAL)2147483647.5)) {
            packet->mask = (uint8_t)(packet->mask | MOCAP_INERTIAL_SAMPLE_FINE_MAGNETIC_FIELD_CLIPPED);
            packet->magnetic_field[i] = (int32_t)(v[i] < 0 ? -2147483647 : 2147483647);
        } else {
            packet->magnetic_field[i] = (int32_t)mocap_nearest_signed(v[i], -2147483647, 2147483647);
        }
    }
}

/* Between steps and rad/s; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_inertial_sample_fine_angular_rate_to_si(int32_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)1e-06;
}

static inline int32_t mocap_inertial_sample_fine_angular_rate_from_si(MOCAP_REAL value) {
    return (int32_t)mocap_nearest_signed(value / (MOCAP_REAL)1e-06, -2147483647, 2147483647);
}

/* Puts a reading into a sample, in steps or in rad/s; beyond the range as its end, clipped. */
static inline void mocap_inertial_sample_fine_set_angular_rate(mocap_inertial_sample_fine *packet, int32_t x,
        int32_t y, int32_t z) {
    const int32_t v[3] = {x, y, z};
    size_t i;
    packet->mask = (uint8_t)((packet->mask | MOCAP_INERTIAL_SAMPLE_FINE_HAS_ANGULAR_RATE) & (0xFFu ^
            MOCAP_INERTIAL_SAMPLE_FINE_ANGULAR_RATE_CLIPPED));
    for (i = 0; i < 3u; ++i) {
        if (v[i] < -2147483647) {
            packet->mask = (uint8_t)(packet->mask | MOCAP_INERTIAL_SAMPLE_FINE_ANGULAR_RATE_CLIPPED);
            packet->angular_rate[i] = (int32_t)(v[i] < 0 ? -2147483647 : 2147483647);
        } else {
            packet->angular_rate[i] = (int32_t)v[i];
        }
    }
}

static inline void mocap_inertial_sample_fine_set_angular_rate_si(mocap_inertial_sample_fine *packet,
        MOCAP_REAL x, MOCAP_REAL y, MOCAP_REAL z) {
    const MOCAP_REAL v[3] = {x / (MOCAP_REAL)1e-06, y / (MOCAP_REAL)1e-06, z / (MOCAP_REAL)1e-06};
    size_t i;
    packet->mask = (uint8_t)((packet->mask | MOCAP_INERTIAL_SAMPLE_FINE_HAS_ANGULAR_RATE) & (0xFFu ^
            MOCAP_INERTIAL_SAMPLE_FINE_ANGULAR_RATE_CLIPPED));
    for (i = 0; i < 3u; ++i) {
        if (!(v[i] > (MOCAP_REAL)-2147483647.5 && v[i] < (MOCAP_REAL)2147483647.5)) {
            packet->mask = (uint8_t)(packet->mask | MOCAP_INERTIAL_SAMPLE_FINE_ANGULAR_RATE_CLIPPED);
            packet->angular_rate[i] = (int32_t)(v[i] < 0 ? -2147483647 : 2147483647);
        } else {
            packet->angular_rate[i] = (int32_t)mocap_nearest_signed(v[i], -2147483647, 2147483647);
        }
    }
}

#define MOCAP_FUSED_SAMPLE_MIN_SIZE 24u
#define MOCAP_FUSED_SAMPLE_MAX_SIZE 24u

/* 0x12. Orientation fused on the module, and how far the module came since its last upload. */
typedef struct {
    /* Unit quaternion w, x, y, z: sensor axes to the module's own level reference. One step is
     * 3.05185095e-05 1. */
    int16_t orientation[4];
    /* Since the last upload, along the axes of that reference. One step is 1e-06 m. */
    int32_t displacement[3];
    /* Time that the displacement covers. One step is 1e-06 s. */
    uint32_t interval;
} mocap_fused_sample;

static inline size_t mocap_encode_fused_sample(const mocap_fused_sample *packet, uint8_t *body, size_t
        capacity) {
    const size_t size = 24u;
    uint8_t *p = body;
    size_t i;
    if (size > capacity) {
        return 0u;
    }
    for (i = 0; i < 4u; ++i) {
        p = mocap_put_i16(p, packet->orientation[i]);
    }
    for (i = 0; i < 3u; ++i) {
        p = mocap_put_i32(p, packet->displacement[i]);
    }
    p = mocap_put_u32(p, packet->interval);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_fused_sample(const uint8_t *body, size_t size, mocap_fused_sample
        *packet) {
    const uint8_t *p = body;
    size_t i;
    if (size != 24u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    for (i = 0; i < 4u; ++i) {
        packet->orientation[i] = mocap_get_i16(p);
        p += 2u;
    }
    for (i = 0; i < 3u; ++i) {
        packet->displacement[i] = mocap_get_i32(p);
        p += 4u;
    }
    packet->interval = mocap_get_u32(p);
    p += 4u;
    (void)p;
    return MOCAP_GOOD;
}

/* Between steps and 1; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_fused_sample_orientation_to_si(int16_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)3.051850947599719e-05;
}

static inline int16_t mocap_fused_sample_orientation_from_si(MOCAP_REAL value) {
    return (int16_t)mocap_nearest_signed(value / (MOCAP_REAL)3.051850947599719e-05, -32768, 32767);
}

/* Between steps and m; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_fused_sample_displacement_to_si(int32_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)1e-06;
}

static inline int32_t mocap_fused_sample_displacement_from_si(MOCAP_REAL value) {
    return (int32_t)mocap_nearest_signed(value / (MOCAP_REAL)1e-06, (-2147483647 - 1), 2147483647);
}

/* Between steps and s; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_fused_sample_interval_to_si(uint32_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)1e-06;
}

static inline uint32_t mocap_fused_sample_interval_from_si(MOCAP_REAL value) {
    return (uint32_t)mocap_nearest_unsigned(value / (MOCAP_REAL)1e-06, 0u, 4294967295u);
}

#define MOCAP_LOCAL_MEASUREMENT_QUANTITY_ACCELERATION 1u /* acceleration, m/s^2 */
#define MOCAP_LOCAL_MEASUREMENT_QUANTITY_VELOCITY 2u /* velocity, m/s */
#define MOCAP_LOCAL_MEASUREMENT_QUANTITY_POSITION 3u /* position, m */
#define MOCAP_LOCAL_MEASUREMENT_MIN_SIZE 25u
#define MOCAP_LOCAL_MEASUREMENT_MAX_SIZE 25u

/* 0x18. One reading of a local measuring device, in world axes (east, north, up). */
typedef struct {
    /* What is measured, and so the unit of the two fields that follow. 1 acceleration, m/s^2; 2
     * velocity, m/s; 3 position, m. */
    uint8_t quantity;
    /* The measured vector. In as quantity. */
    float value[3];
    /* Standard deviation of each component. In as quantity. At least 0. */
    float sigma[3];
} mocap_local_measurement;

/* Whether every field has a value that it allows. */
static inline bool mocap_local_measurement_is_valid(const mocap_local_measurement *packet) {
    size_t i;
    if (packet->quantity < 1u || packet->quantity > 3u) {
        return false;
    }
    for (i = 0; i < 3u; ++i) {
        if (!mocap_is_finite(packet->value[i])) {
            return false;
        }
    }
    for (i = 0; i < 3u; ++i) {
        if (!mocap_is_finite(packet->sigma[i]) || packet->sigma[i] < 0.0f) {
            return false;
        }
    }
    return true;
}

static inline size_t mocap_encode_local_measurement(const mocap_local_measurement *packet, uint8_t *body,
        size_t capacity) {
    const size_t size = 25u;
    uint8_t *p = body;
    size_t i;
    if (size > capacity || !mocap_local_measurement_is_valid(packet)) {
        return 0u;
    }
    p = mocap_put_u8(p, packet->quantity);
    for (i = 0; i < 3u; ++i) {
        p = mocap_put_f32(p, packet->value[i]);
    }
    for (i = 0; i < 3u; ++i) {
        p = mocap_put_f32(p, packet->sigma[i]);
    }
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_local_measurement(const uint8_t *body, size_t size,
        mocap_local_measurement *packet) {
    const uint8_t *p = body;
    size_t i;
    if (size != 25u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->quantity = mocap_get_u8(p);
    p += 1u;
    for (i = 0; i < 3u; ++i) {
        packet->value[i] = mocap_get_f32(p);
        p += 4u;
    }
    for (i = 0; i < 3u; ++i) {
        packet->sigma[i] = mocap_get_f32(p);
        p += 4u;
    }
    (void)p;
    return mocap_local_measurement_is_valid(packet) ? MOCAP_GOOD : MOCAP_BAD_VALUE;
}

#define MOCAP_LIGHT_SAMPLE_MIN_SIZE 12u
#define MOCAP_LIGHT_SAMPLE_MAX_SIZE 12u

/* 0x19. One reading of the photoelectric cells on the six faces of a module. */
typedef struct {
    /* Light on the faces +x, -x, +y, -y, +z, -z; at full scale the cell is saturated. One step is
     * 1.52590219e-05 full scale. */
    uint16_t intensity[6];
} mocap_light_sample;

static inline size_t mocap_encode_light_sample(const mocap_light_sample *packet, uint8_t *body, size_t
        capacity) {
    const size_t size = 12u;
    uint8_t *p = body;
    size_t i;
    if (size > capacity) {
        return 0u;
    }
    for (i = 0; i < 6u; ++i) {
        p = mocap_put_u16(p, packet->intensity[i]);
    }
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_light_sample(const uint8_t *body, size_t size, mocap_light_sample
        *packet) {
    const uint8_t *p = body;
    size_t i;
    if (size != 12u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    for (i = 0; i < 6u; ++i) {
        packet->intensity[i] = mocap_get_u16(p);
        p += 2u;
    }
    (void)p;
    return MOCAP_GOOD;
}

/* Between steps and full scale; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_light_sample_intensity_to_si(uint16_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)1.5259021896696422e-05;
}

static inline uint16_t mocap_light_sample_intensity_from_si(MOCAP_REAL value) {
    return (uint16_t)mocap_nearest_unsigned(value / (MOCAP_REAL)1.5259021896696422e-05, 0u, 65535u);
}

#define MOCAP_PRESSURE_SAMPLE_TEMPERATURE_CELSIUS_ABSENT -32768
#define MOCAP_PRESSURE_SAMPLE_MIN_SIZE 18u
#define MOCAP_PRESSURE_SAMPLE_MAX_SIZE 18u

/* 0x1A. One reading of a device with pressure tubes. */
typedef struct {
    /* Of the tubes along the device's x, y and z axes. In Pa. */
    float differential_pressure[3];
    /* Pressure of the still air. In Pa. */
    float static_pressure;
    /* Temperature of the air. One step is 0.01 degC. -32768: none or not known. */
    int16_t temperature_celsius;
} mocap_pressure_sample;

/* Whether every field has a value that it allows. */
static inline bool mocap_pressure_sample_is_valid(const mocap_pressure_sample *packet) {
    size_t i;
    for (i = 0; i < 3u; ++i) {
        if (!mocap_is_finite(packet->differential_pressure[i])) {
            return false;
        }
    }
    if (!mocap_is_finite(packet->static_pressure)) {
        return false;
    }
    return true;
}

static inline size_t mocap_encode_pressure_sample(const mocap_pressure_sample *packet, uint8_t *body, size_t
        capacity) {
    const size_t size = 18u;
    uint8_t *p = body;
    size_t i;
    if (size > capacity || !mocap_pressure_sample_is_valid(packet)) {
        return 0u;
    }
    for (i = 0; i < 3u; ++i) {
        p = mocap_put_f32(p, packet->differential_pressure[i]);
    }
    p = mocap_put_f32(p, packet->static_pressure);
    p = mocap_put_i16(p, packet->temperature_celsius);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_pressure_sample(const uint8_t *body, size_t size,
        mocap_pressure_sample *packet) {
    const uint8_t *p = body;
    size_t i;
    if (size != 18u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    for (i = 0; i < 3u; ++i) {
        packet->differential_pressure[i] = mocap_get_f32(p);
        p += 4u;
    }
    packet->static_pressure = mocap_get_f32(p);
    p += 4u;
    packet->temperature_celsius = mocap_get_i16(p);
    p += 2u;
    (void)p;
    return mocap_pressure_sample_is_valid(packet) ? MOCAP_GOOD : MOCAP_BAD_VALUE;
}

/* Between steps and degC; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_pressure_sample_temperature_celsius_to_si(int16_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)0.01;
}

static inline int16_t mocap_pressure_sample_temperature_celsius_from_si(MOCAP_REAL value) {
    return (int16_t)mocap_nearest_signed(value / (MOCAP_REAL)0.01, -32767, 32767);
}

#define MOCAP_PASS_THROUGH_FORMAT_NMEA 1u
#define MOCAP_PASS_THROUGH_FORMAT_UBX 2u
#define MOCAP_PASS_THROUGH_FORMAT_UWB_RANGES 3u
#define MOCAP_PASS_THROUGH_MIN_SIZE 2u
#define MOCAP_PASS_THROUGH_MAX_SIZE 241u

/* 0x1B. What a receiver attached to a local measuring device said, unchanged. */
typedef struct {
    /* What the data are. 1 NMEA; 2 UBX; 3 UWB ranges. */
    uint8_t format;
    /* The receiver's own bytes. 1 to 240 bytes. */
    const uint8_t *data;
    size_t data_size;
} mocap_pass_through;

/* Whether every field has a value that it allows. */
static inline bool mocap_pass_through_is_valid(const mocap_pass_through *packet) {
    if (packet->format < 1u || packet->format > 3u) {
        return false;
    }
    return true;
}

static inline size_t mocap_encode_pass_through(const mocap_pass_through *packet, uint8_t *body, size_t
        capacity) {
    const size_t size = 1u + packet->data_size;
    uint8_t *p = body;
    if (packet->data_size < 1u || packet->data_size > 240u) {
        return 0u;
    }
    if (size > capacity || !mocap_pass_through_is_valid(packet)) {
        return 0u;
    }
    p = mocap_put_u8(p, packet->format);
    p = mocap_put_bytes(p, packet->data, packet->data_size);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_pass_through(const uint8_t *body, size_t size, mocap_pass_through
        *packet) {
    const uint8_t *p = body;
    if (size < 2u || size > 241u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->format = mocap_get_u8(p);
    p += 1u;
    packet->data = p;
    packet->data_size = size - (size_t)(p - body);
    return mocap_pass_through_is_valid(packet) ? MOCAP_GOOD : MOCAP_BAD_VALUE;
}

#define MOCAP_DEVICE_INFO_ACCELEROMETER_RANGE_ABSENT 0u
#define MOCAP_DEVICE_INFO_GYROSCOPE_RANGE_ABSENT 0u
#define MOCAP_DEVICE_INFO_MAGNETOMETER_RANGE_ABSENT 0u
#define MOCAP_DEVICE_INFO_ACCELEROMETER_SAMPLING_RATE_ABSENT 0u
#define MOCAP_DEVICE_INFO_GYROSCOPE_SAMPLING_RATE_ABSENT 0u
#define MOCAP_DEVICE_INFO_MAGNETOMETER_SAMPLING_RATE_ABSENT 0u
#define MOCAP_DEVICE_INFO_MIN_SIZE 29u
#define MOCAP_DEVICE_INFO_MAX_SIZE 29u

/* 0x30. Who a module is and what it carries. A sensor that is not there has no range and no rate. */
typedef struct {
    /* Number of the chip, never the same twice. */
    uint8_t unique_id[12];
    /* Major, minor. */
    uint8_t hardware_version[2];
    /* Major, minor, patch. */
    uint8_t firmware_version[3];
    /* Largest specific force of an axis. One step is 0.1 m/s^2. 0: none or not known. */
    uint16_t accelerometer_range;
    /* Largest angular rate of an axis; one step is 1 deg/s. One step is 0.0174532925 rad/s. 0: none
     * or not known. */
    uint16_t gyroscope_range;
    /* Largest magnetic field of an axis. One step is 1 uT. 0: none or not known. */
    uint16_t magnetometer_range;
    /* Samples of the accelerometer each second. One step is 0.1 Hz. 0: none or not known. */
    uint16_t accelerometer_sampling_rate;
    /* Samples of the gyroscope each second. One step is 0.1 Hz. 0: none or not known. */
    uint16_t gyroscope_sampling_rate;
    /* Samples of the magnetometer each second. One step is 0.1 Hz. 0: none or not known. */
    uint16_t magnetometer_sampling_rate;
} mocap_device_info;

static inline size_t mocap_encode_device_info(const mocap_device_info *packet, uint8_t *body, size_t capacity)
        {
    const size_t size = 29u;
    uint8_t *p = body;
    size_t i;
    if (size > capacity) {
        return 0u;
    }
    p = mocap_put_bytes(p, packet->unique_id, 12u);
    for (i = 0; i < 2u; ++i) {
        p = mocap_put_u8(p, packet->hardware_version[i]);
    }
    for (i = 0; i < 3u; ++i) {
        p = mocap_put_u8(p, packet->firmware_version[i]);
    }
    p = mocap_put_u16(p, packet->accelerometer_range);
    p = mocap_put_u16(p, packet->gyroscope_range);
    p = mocap_put_u16(p, packet->magnetometer_range);
    p = mocap_put_u16(p, packet->accelerometer_sampling_rate);
    p = mocap_put_u16(p, packet->gyroscope_sampling_rate);
    p = mocap_put_u16(p, packet->magnetometer_sampling_rate);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_device_info(const uint8_t *body, size_t size, mocap_device_info
        *packet) {
    const uint8_t *p = body;
    size_t i;
    if (size != 29u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    memcpy(packet->unique_id, p, 12u);
    p += 12u;
    for (i = 0; i < 2u; ++i) {
        packet->hardware_version[i] = mocap_get_u8(p);
        p += 1u;
    }
    for (i = 0; i < 3u; ++i) {
        packet->firmware_version[i] = mocap_get_u8(p);
        p += 1u;
    }
    packet->accelerometer_range = mocap_get_u16(p);
    p += 2u;
    packet->gyroscope_range = mocap_get_u16(p);
    p += 2u;
    packet->magnetometer_range = mocap_get_u16(p);
    p += 2u;
    packet->accelerometer_sampling_rate = mocap_get_u16(p);
    p += 2u;
    packet->gyroscope_sampling_rate = mocap_get_u16(p);
    p += 2u;
    packet->magnetometer_sampling_rate = mocap_get_u16(p);
    p += 2u;
    (void)p;
    return MOCAP_GOOD;
}

/* Between steps and m/s^2; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_device_info_accelerometer_range_to_si(uint16_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)0.1;
}

static inline uint16_t mocap_device_info_accelerometer_range_from_si(MOCAP_REAL value) {
    return (uint16_t)mocap_nearest_unsigned(value / (MOCAP_REAL)0.1, 1u, 65535u);
}

/* Between steps and rad/s; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_device_info_gyroscope_range_to_si(uint16_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)0.017453292519943295;
}

static inline uint16_t mocap_device_info_gyroscope_range_from_si(MOCAP_REAL value) {
    return (uint16_t)mocap_nearest_unsigned(value / (MOCAP_REAL)0.017453292519943295, 1u, 65535u);
}

/* Between steps and uT; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_device_info_magnetometer_range_to_si(uint16_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)1.0;
}

static inline uint16_t mocap_device_info_magnetometer_range_from_si(MOCAP_REAL value) {
    return (uint16_t)mocap_nearest_unsigned(value / (MOCAP_REAL)1.0, 1u, 65535u);
}

/* Between steps and Hz; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_device_info_accelerometer_sampling_rate_to_si(uint16_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)0.1;
}

static inline uint16_t mocap_device_info_accelerometer_sampling_rate_from_si(MOCAP_REAL value) {
    return (uint16_t)mocap_nearest_unsigned(value / (MOCAP_REAL)0.1, 1u, 65535u);
}

/* Between steps and Hz; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_device_info_gyroscope_sampling_rate_to_si(uint16_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)0.1;
}

static inline uint16_t mocap_device_info_gyroscope_sampling_rate_from_si(MOCAP_REAL value) {
    return (uint16_t)mocap_nearest_unsigned(value / (MOCAP_REAL)0.1, 1u, 65535u);
}

/* Between steps and Hz; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_device_info_magnetometer_sampling_rate_to_si(uint16_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)0.1;
}

static inline uint16_t mocap_device_info_magnetometer_sampling_rate_from_si(MOCAP_REAL value) {
    return (uint16_t)mocap_nearest_unsigned(value / (MOCAP_REAL)0.1, 1u, 65535u);
}

#define MOCAP_HEALTH_BATTERY_PERCENT_ABSENT 255u
#define MOCAP_HEALTH_BATTERY_PERCENT_MIN 0u
#define MOCAP_HEALTH_BATTERY_PERCENT_MAX 100u
#define MOCAP_HEALTH_BATTERY_VOLTAGE_ABSENT 65535u
#define MOCAP_HEALTH_TEMPERATURE_CELSIUS_ABSENT -32768
#define MOCAP_HEALTH_RSSI_DBM_ABSENT 127
#define MOCAP_HEALTH_MIN_SIZE 20u
#define MOCAP_HEALTH_MAX_SIZE 20u

/* 0x31. How a module fares. What a module cannot know has a reserved number. Counters wrap to 0. */
typedef struct {
    /* Charge left in the battery. In %. From 0 to 100 steps. 255: none or not known. */
    uint8_t battery_percent;
    /* Voltage of the battery. One step is 0.001 V. 65535: none or not known. */
    uint16_t battery_voltage;
    /* Temperature of the inertial sensors. One step is 0.01 degC. -32768: none or not known. */
    int16_t temperature_celsius;
    /* Strength of the radio signal received. In dBm. 127: none or not known. */
    int8_t rssi_dbm;
    /* Time since the last reset. In s. */
    uint32_t uptime_s;
    /* Samples taken since the last reset. */
    uint32_t samples_taken;
    /* Samples taken that could not be sent since the last reset. */
    uint16_t samples_dropped;
    /* Failed readings since the last reset. */
    uint16_t sensor_errors;
    /* Resets since the firmware was installed. */
    uint16_t resets;
} mocap_health;

/* Whether every field has a value that it allows. */
static inline bool mocap_health_is_valid(const mocap_health *packet) {
    if ((packet->battery_percent != 255u && (packet->battery_percent > 100u))) {
        return false;
    }
    return true;
}

static inline size_t mocap_encode_health(const mocap_health *packet, uint8_t *body, size_t capacity) {
    const size_t size = 20u;
    uint8_t *p = body;
    if (size > capacity || !mocap_health_is_valid(packet)) {
        return 0u;
    }
    p = mocap_put_u8(p, packet->battery_percent);
    p = mocap_put_u16(p, packet->battery_voltage);
    p = mocap_put_i16(p, packet->temperature_celsius);
    p = mocap_put_i8(p, packet->rssi_dbm);
    p = mocap_put_u32(p, packet->uptime_s);
    p = mocap_put_u32(p, packet->samples_taken);
    p = mocap_put_u16(p, packet->samples_dropped);
    p = mocap_put_u16(p, packet->sensor_errors);
    p = mocap_put_u16(p, packet->resets);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_health(const uint8_t *body, size_t size, mocap_health *packet) {
    const uint8_t *p = body;
    if (size != 20u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->battery_percent = mocap_get_u8(p);
    p += 1u;
    packet->battery_voltage = mocap_get_u16(p);
    p += 2u;
    packet->temperature_celsius = mocap_get_i16(p);
    p += 2u;
    packet->rssi_dbm = mocap_get_i8(p);
    p += 1u;
    packet->uptime_s = mocap_get_u32(p);
    p += 4u;
    packet->samples_taken = mocap_get_u32(p);
    p += 4u;
    packet->samples_dropped = mocap_get_u16(p);
    p += 2u;
    packet->sensor_errors = mocap_get_u16(p);
    p += 2u;
    packet->resets = mocap_get_u16(p);
    p += 2u;
    (void)p;
    return mocap_health_is_valid(packet) ? MOCAP_GOOD : MOCAP_BAD_VALUE;
}

/* Between steps and V; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_health_battery_voltage_to_si(uint16_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)0.001;
}

static inline uint16_t mocap_health_battery_voltage_from_si(MOCAP_REAL value) {
    return (uint16_t)mocap_nearest_unsigned(value / (MOCAP_REAL)0.001, 0u, 65534u);
}

/* Between steps and degC; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_health_temperature_celsius_to_si(int16_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)0.01;
}

static inline int16_t mocap_health_temperature_celsius_from_si(MOCAP_REAL value) {
    return (int16_t)mocap_nearest_signed(value / (MOCAP_REAL)0.01, -32767, 32767);
}

#define MOCAP_EVENT_BUTTON 1u
#define MOCAP_EVENT_TAP 2u
#define MOCAP_EVENT_DOUBLE_TAP 3u
#define MOCAP_EVENT_SHAKE 4u
#define MOCAP_EVENT_CHARGER_CONNECTED 5u
#define MOCAP_EVENT_CHARGER_REMOVED 6u
#define MOCAP_EVENT_SETTINGS_COMMITTED 7u
#define MOCAP_EVENT_STARTED_FROM_THE_FACTORY_SETTINGS 8u
#define MOCAP_EVENT_MIN_SIZE 2u
#define MOCAP_EVENT_MAX_SIZE 2u

/* 0x32. Something happened to a module, just now. */
typedef struct {
    /* What happened. 1 button; 2 tap; 3 double tap; 4 shake; 5 charger connected; 6 charger removed;
     * 7 settings committed; 8 started from the factory settings. */
    uint8_t event;
    /* Which one, or how many times; 0 where neither applies. */
    uint8_t value;
} mocap_event;

/* Whether every field has a value that it allows. */
static inline bool mocap_event_is_valid(const mocap_event *packet) {
    if (packet->event < 1u || packet->event > 8u) {
        return false;
    }
    return true;
}

static inline size_t mocap_encode_event(const mocap_event *packet, uint8_t *body, size_t capacity) {
    const size_t size = 2u;
    uint8_t *p = body;
    if (size > capacity || !mocap_event_is_valid(packet)) {
        return 0u;
    }
    p = mocap_put_u8(p, packet->event);
    p = mocap_put_u8(p, packet->value);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_event(const uint8_t *body, size_t size, mocap_event *packet) {
    const uint8_t *p = body;
    if (size != 2u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->event = mocap_get_u8(p);
    p += 1u;
    packet->value = mocap_get_u8(p);
    p += 1u;
    (void)p;
    return mocap_event_is_valid(packet) ? MOCAP_GOOD : MOCAP_BAD_VALUE;
}

#define MOCAP_LOG_LINE_LEVEL_ERROR 1u
#define MOCAP_LOG_LINE_LEVEL_WARNING 2u
#define MOCAP_LOG_LINE_LEVEL_INFO 3u
#define MOCAP_LOG_LINE_LEVEL_DEBUG 4u
#define MOCAP_LOG_LINE_MIN_SIZE 1u
#define MOCAP_LOG_LINE_MAX_SIZE 201u

/* 0x33. One line of a module's log. */
typedef struct {
    /* How serious it is. 1 error; 2 warning; 3 info; 4 debug. */
    uint8_t level;
    /* UTF-8, not ended by a zero. 0 to 200 bytes. */
    const uint8_t *text;
    size_t text_size;
} mocap_log_line;

/* Whether every field has a value that it allows. */
static inline bool mocap_log_line_is_valid(const mocap_log_line *packet) {
    if (packet->level < 1u || packet->level > 4u) {
        return false;
    }
    if (!mocap_is_text(packet->text, packet->text_size)) {
        return false;
    }
    return true;
}

static inline size_t mocap_encode_log_line(const mocap_log_line *packet, uint8_t *body, size_t capacity) {
    const size_t size = 1u + packet->text_size;
    uint8_t *p = body;
    if (packet->text_size > 200u) {
        return 0u;
    }
    if (size > capacity || !mocap_log_line_is_valid(packet)) {
        return 0u;
    }
    p = mocap_put_u8(p, packet->level);
    p = mocap_put_bytes(p, packet->text, packet->text_size);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_log_line(const uint8_t *body, size_t size, mocap_log_line *packet) {
    const uint8_t *p = body;
    if (size < 1u || size > 201u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->level = mocap_get_u8(p);
    p += 1u;
    packet->text = p;
    packet->text_size = size - (size_t)(p - body);
    return mocap_log_line_is_valid(packet) ? MOCAP_GOOD : MOCAP_BAD_VALUE;
}

#define MOCAP_SYNC_REQUEST_MIN_SIZE 10u
#define MOCAP_SYNC_REQUEST_MAX_SIZE 10u

/* 0x40. Asks a module for its clock; the host measures how long the answer takes. */
typedef struct {
    /* Returned in the response. */
    uint16_t token;
    /* The host's clock when this was sent. In us. */
    uint64_t host_time_us;
} mocap_sync_request;

static inline size_t mocap_encode_sync_request(const mocap_sync_request *packet, uint8_t *body, size_t
        capacity) {
    const size_t size = 10u;
    uint8_t *p = body;
    if (size > capacity) {
        return 0u;
    }
    p = mocap_put_u16(p, packet->token);
    p = mocap_put_u64(p, packet->host_time_us);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_sync_request(const uint8_t *body, size_t size, mocap_sync_request
        *packet) {
    const uint8_t *p = body;
    if (size != 10u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->token = mocap_get_u16(p);
    p += 2u;
    packet->host_time_us = mocap_get_u64(p);
    p += 8u;
    (void)p;
    return MOCAP_GOOD;
}

#define MOCAP_SYNC_RESPONSE_MIN_SIZE 10u
#define MOCAP_SYNC_RESPONSE_MAX_SIZE 10u

/* 0x41. The module's clock when a request came and when this was sent. */
typedef struct {
    /* That of the request. */
    uint16_t token;
    /* The module's clock when the request came, wraps to 0. In us. */
    uint32_t received_us;
    /* The module's clock when this was sent, wraps to 0. In us. */
    uint32_t sent_us;
} mocap_sync_response;

static inline size_t mocap_encode_sync_response(const mocap_sync_response *packet, uint8_t *body, size_t
        capacity) {
    const size_t size = 10u;
    uint8_t *p = body;
    if (size > capacity) {
        return 0u;
    }
    p = mocap_put_u16(p, packet->token);
    p = mocap_put_u32(p, packet->received_us);
    p = mocap_put_u32(p, packet->sent_us);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_sync_response(const uint8_t *body, size_t size, mocap_sync_response
        *packet) {
    const uint8_t *p = body;
    if (size != 10u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->token = mocap_get_u16(p);
    p += 2u;
    packet->received_us = mocap_get_u32(p);
    p += 4u;
    packet->sent_us = mocap_get_u32(p);
    p += 4u;
    (void)p;
    return MOCAP_GOOD;
}

#define MOCAP_SAMPLING_TRIGGER_MIN_SIZE 2u
#define MOCAP_SAMPLING_TRIGGER_MAX_SIZE 2u

/* 0x42. Sample now. The sample is marked as triggered, and its sequence number is this number. */
typedef struct {
    /* Counts triggers, wraps to 0. */
    uint16_t number;
} mocap_sampling_trigger;

static inline size_t mocap_encode_sampling_trigger(const mocap_sampling_trigger *packet, uint8_t *body, size_t
        capacity) {
    const size_t size = 2u;
    uint8_t *p = body;
    if (size > capacity) {
        return 0u;
    }
    p = mocap_put_u16(p, packet->number);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_sampling_trigger(const uint8_t *body, size_t size,
        mocap_sampling_trigger *packet) {
    const uint8_t *p = body;
    if (size != 2u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->number = mocap_get_u16(p);
    p += 2u;
    (void)p;
    return MOCAP_GOOD;
}

#define MOCAP_COMMAND_MIN_SIZE 15u
#define MOCAP_COMMAND_MAX_SIZE 215u

/* 0x50. The host asks a module to do something; verbs are listed under "Commands". */
typedef struct {
    /* The same when a command is repeated. */
    uint16_t transaction;
    /* What to do. */
    uint8_t verb;
    /* Only the device of this number acts, whatever its id. All zeros: whoever the header names. */
    uint8_t unique_id[12];
    /* As the verb declares. 0 to 200 bytes. */
    const uint8_t *arguments;
    size_t arguments_size;
} mocap_command;

static inline size_t mocap_encode_command(const mocap_command *packet, uint8_t *body, size_t capacity) {
    const size_t size = 15u + packet->arguments_size;
    uint8_t *p = body;
    if (packet->arguments_size > 200u) {
        return 0u;
    }
    if (size > capacity) {
        return 0u;
    }
    p = mocap_put_u16(p, packet->transaction);
    p = mocap_put_u8(p, packet->verb);
    p = mocap_put_bytes(p, packet->unique_id, 12u);
    p = mocap_put_bytes(p, packet->arguments, packet->arguments_size);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_command(const uint8_t *body, size_t size, mocap_command *packet) {
    const uint8_t *p = body;
    if (size < 15u || size > 215u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->transaction = mocap_get_u16(p);
    p += 2u;
    packet->verb = mocap_get_u8(p);
    p += 1u;
    memcpy(packet->unique_id, p, 12u);
    p += 12u;
    packet->arguments = p;
    packet->arguments_size = size - (size_t)(p - body);
    return MOCAP_GOOD;
}

#define MOCAP_ACKNOWLEDGEMENT_MIN_SIZE 16u
#define MOCAP_ACKNOWLEDGEMENT_MAX_SIZE 216u

/* 0x51. A module's answer to a command. */
typedef struct {
    /* That of the command. */
    uint16_t transaction;
    /* That of the command. */
    uint8_t verb;
    /* How it ended. 0 done; 1 unknown verb; 2 bad arguments; 3 refused: writes are locked on the
     * device; 4 busy; 5 flash failed; 6 no such setting; 7 no such file; 8 nothing staged; 9 not
     * supported by this device. */
    uint8_t result;
    /* Number of the chip that answers. */
    uint8_t unique_id[12];
    /* As the verb declares; empty unless the result is 0. 0 to 200 bytes. */
    const uint8_t *payload;
    size_t payload_size;
} mocap_acknowledgement;

/* Whether every field has a value that it allows. */
static inline bool mocap_acknowledgement_is_valid(const mocap_acknowledgement *packet) {
    if (packet->result > 9u) {
        return false;
    }
    return true;
}

static inline size_t mocap_encode_acknowledgement(const mocap_acknowledgement *packet, uint8_t *body, size_t
        capacity) {
    const size_t size = 16u + packet->payload_size;
    uint8_t *p = body;
    if (packet->payload_size > 200u) {
        return 0u;
    }
    if (size > capacity || !mocap_acknowledgement_is_valid(packet)) {
        return 0u;
    }
    p = mocap_put_u16(p, packet->transaction);
    p = mocap_put_u8(p, packet->verb);
    p = mocap_put_u8(p, packet->result);
    p = mocap_put_bytes(p, packet->unique_id, 12u);
    p = mocap_put_bytes(p, packet->payload, packet->payload_size);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_acknowledgement(const uint8_t *body, size_t size,
        mocap_acknowledgement *packet) {
    const uint8_t *p = body;
    if (size < 16u || size > 216u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->transaction = mocap_get_u16(p);
    p += 2u;
    packet->verb = mocap_get_u8(p);
    p += 1u;
    packet->result = mocap_get_u8(p);
    p += 1u;
    memcpy(packet->unique_id, p, 12u);
    p += 12u;
    packet->payload = p;
    packet->payload_size = size - (size_t)(p - body);
    return mocap_acknowledgement_is_valid(packet) ? MOCAP_GOOD : MOCAP_BAD_VALUE;
}

#define MOCAP_TRANSFER_TO_MODULE_PIECE_FIRST 1u
#define MOCAP_TRANSFER_TO_MODULE_PIECE_CONSECUTIVE 2u
#define MOCAP_TRANSFER_TO_MODULE_PIECE_FLOW_CONTROL 3u
#define MOCAP_TRANSFER_TO_MODULE_MIN_SIZE 4u
#define MOCAP_TRANSFER_TO_MODULE_MAX_SIZE 245u

/* 0x5E. A piece from the host: of its own long wire frame, or flow control for a module's. */
typedef struct {
    /* What it is. 1 first; 2 consecutive; 3 flow control. */
    uint8_t piece;
    /* Counts the sender's transfers, wraps to 0. */
    uint8_t transfer;
    /* First: bytes of the whole. Consecutive: its place, from 1. Flow control: place of the piece
     * wanted next. */
    uint16_t number;
    /* Bytes of the whole; in flow control, what it asks. 0 to 241 bytes. */
    const uint8_t *data;
    size_t data_size;
} mocap_transfer_to_module;

/* Whether every field has a value that it allows. */
static inline bool mocap_transfer_to_module_is_valid(const mocap_transfer_to_module *packet) {
    if (packet->piece < 1u || packet->piece > 3u) {
        return false;
    }
    return true;
}

static inline size_t mocap_encode_transfer_to_module(const mocap_transfer_to_module *packet, uint8_t *body,
        size_t capacity) {
    const size_t size = 4u + packet->data_size;
    uint8_t *p = body;
    if (packet->data_size > 241u) {
        return 0u;
    }
    if (size > capacity || !mocap_transfer_to_module_is_valid(packet)) {
        return 0u;
    }
    p = mocap_put_u8(p, packet->piece);
    p = mocap_put_u8(p, packet->transfer);
    p = mocap_put_u16(p, packet->number);
    p = mocap_put_bytes(p, packet->data, packet->data_size);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_transfer_to_module(const uint8_t *body, size_t size,
        mocap_transfer_to_module *packet) {
    const uint8_t *p = body;
    if (size < 4u || size > 245u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->piece = mocap_get_u8(p);
    p += 1u;
    packet->transfer = mocap_get_u8(p);
    p += 1u;
    packet->number = mocap_get_u16(p);
    p += 2u;
    packet->data = p;
    packet->data_size = size - (size_t)(p - body);
    return mocap_transfer_to_module_is_valid(packet) ? MOCAP_GOOD : MOCAP_BAD_VALUE;
}

#define MOCAP_TRANSFER_TO_HOST_PIECE_FIRST 1u
#define MOCAP_TRANSFER_TO_HOST_PIECE_CONSECUTIVE 2u
#define MOCAP_TRANSFER_TO_HOST_PIECE_FLOW_CONTROL 3u
#define MOCAP_TRANSFER_TO_HOST_MIN_SIZE 4u
#define MOCAP_TRANSFER_TO_HOST_MAX_SIZE 245u

/* 0x5F. A piece from a module: of its own long wire frame, or flow control for the host's. */
typedef struct {
    /* What it is. 1 first; 2 consecutive; 3 flow control. */
    uint8_t piece;
    /* Counts the sender's transfers, wraps to 0. */
    uint8_t transfer;
    /* First: bytes of the whole. Consecutive: its place, from 1. Flow control: place of the piece
     * wanted next. */
    uint16_t number;
    /* Bytes of the whole; in flow control, what it asks. 0 to 241 bytes. */
    const uint8_t *data;
    size_t data_size;
} mocap_transfer_to_host;

/* Whether every field has a value that it allows. */
static inline bool mocap_transfer_to_host_is_valid(const mocap_transfer_to_host *packet) {
    if (packet->piece < 1u || packet->piece > 3u) {
        return false;
    }
    return true;
}

static inline size_t mocap_encode_transfer_to_host(const mocap_transfer_to_host *packet, uint8_t *body, size_t
        capacity) {
    const size_t size = 4u + packet->data_size;
    uint8_t *p = body;
    if (packet->data_size > 241u) {
        return 0u;
    }
    if (size > capacity || !mocap_transfer_to_host_is_valid(packet)) {
        return 0u;
    }
    p = mocap_put_u8(p, packet->piece);
    p = mocap_put_u8(p, packet->transfer);
    p = mocap_put_u16(p, packet->number);
    p = mocap_put_bytes(p, packet->data, packet->data_size);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_transfer_to_host(const uint8_t *body, size_t size,
        mocap_transfer_to_host *packet) {
    const uint8_t *p = body;
    if (size < 4u || size > 245u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->piece = mocap_get_u8(p);
    p += 1u;
    packet->transfer = mocap_get_u8(p);
    p += 1u;
    packet->number = mocap_get_u16(p);
    p += 2u;
    packet->data = p;
    packet->data_size = size - (size_t)(p - body);
    return mocap_transfer_to_host_is_valid(packet) ? MOCAP_GOOD : MOCAP_BAD_VALUE;
}

/* A packet of any kind. */
typedef struct {
    uint8_t kind; /* mocap_kind */
    union {
        mocap_inertial_sample inertial_sample;
        mocap_inertial_sample_fine inertial_sample_fine;
        mocap_fused_sample fused_sample;
        mocap_local_measurement local_measurement;
        mocap_light_sample light_sample;
        mocap_pressure_sample pressure_sample;
        mocap_pass_through pass_through;
        mocap_device_info device_info;
        mocap_health health;
        mocap_event event;
        mocap_log_line log_line;
        mocap_sync_request sync_request;
        mocap_sync_response sync_response;
        mocap_sampling_trigger sampling_trigger;
        mocap_command command;
        mocap_acknowledgement acknowledgement;
        mocap_transfer_to_module transfer_to_module;
        mocap_transfer_to_host transfer_to_host;
    } as;
} mocap_packet;

/* The packet that a body holds, or why it holds none. */
static inline mocap_defect mocap_decode_packet(uint8_t kind, const uint8_t *body, size_t size, mocap_packet
        *packet) {
    packet->kind = kind;
    switch (kind) {
        case MOCAP_KIND_INERTIAL_SAMPLE:
            return mocap_decode_inertial_sample(body, size, &packet->as.inertial_sample);
        case MOCAP_KIND_INERTIAL_SAMPLE_FINE:
            return mocap_decode_inertial_sample_fine(body, size, &packet->as.inertial_sample_fine);
        case MOCAP_KIND_FUSED_SAMPLE:
            return mocap_decode_fused_sample(body, size, &packet->as.fused_sample);
        case MOCAP_KIND_LOCAL_MEASUREMENT:
            return mocap_decode_local_measurement(body, size, &packet->as.local_measurement);
        case MOCAP_KIND_LIGHT_SAMPLE:
            return mocap_decode_light_sample(body, size, &packet->as.light_sample);
        case MOCAP_KIND_PRESSURE_SAMPLE:
            return mocap_decode_pressure_sample(body, size, &packet->as.pressure_sample);
        case MOCAP_KIND_PASS_THROUGH:
            return mocap_decode_pass_through(body, size, &packet->as.pass_through);
        case MOCAP_KIND_DEVICE_INFO:
            return mocap_decode_device_info(body, size, &packet->as.device_info);
        case MOCAP_KIND_HEALTH:
            return mocap_decode_health(body, size, &packet->as.health);
        case MOCAP_KIND_EVENT:
            return mocap_decode_event(body, size, &packet->as.event);
        case MOCAP_KIND_LOG_LINE:
            return mocap_decode_log_line(body, size, &packet->as.log_line);
        case MOCAP_KIND_SYNC_REQUEST:
            return mocap_decode_sync_request(body, size, &packet->as.sync_request);
        case MOCAP_KIND_SYNC_RESPONSE:
            return mocap_decode_sync_response(body, size, &packet->as.sync_response);
        case MOCAP_KIND_SAMPLING_TRIGGER:
            return mocap_decode_sampling_trigger(body, size, &packet->as.sampling_trigger);
        case MOCAP_KIND_COMMAND:
            return mocap_decode_command(body, size, &packet->as.command);
        case MOCAP_KIND_ACKNOWLEDGEMENT:
            return mocap_decode_acknowledgement(body, size, &packet->as.acknowledgement);
        case MOCAP_KIND_TRANSFER_TO_MODULE:
            return mocap_decode_transfer_to_module(body, size, &packet->as.transfer_to_module);
        case MOCAP_KIND_TRANSFER_TO_HOST:
            return mocap_decode_transfer_to_host(body, size, &packet->as.transfer_to_host);
        default:
            return MOCAP_UNKNOWN_KIND;
    }
}

static inline size_t mocap_encode_packet(const mocap_packet *packet, uint8_t *body, size_t capacity) {
    switch (packet->kind) {
        case MOCAP_KIND_INERTIAL_SAMPLE:
            return mocap_encode_inertial_sample(&packet->as.inertial_sample, body, capacity);
        case MOCAP_KIND_INERTIAL_SAMPLE_FINE:
            return mocap_encode_inertial_sample_fine(&packet->as.inertial_sample_fine, body, capacity);
        case MOCAP_KIND_FUSED_SAMPLE:
            return mocap_encode_fused_sample(&packet->as.fused_sample, body, capacity);
        case MOCAP_KIND_LOCAL_MEASUREMENT:
            return mocap_encode_local_measurement(&packet->as.local_measurement, body, capacity);
        case MOCAP_KIND_LIGHT_SAMPLE:
            return mocap_encode_light_sample(&packet->as.light_sample, body, capacity);
        case MOCAP_KIND_PRESSURE_SAMPLE:
            return mocap_encode_pressure_sample(&packet->as.pressure_sample, body, capacity);
        case MOCAP_KIND_PASS_THROUGH:
            return mocap_encode_pass_through(&packet->as.pass_through, body, capacity);
        case MOCAP_KIND_DEVICE_INFO:
            return mocap_encode_device_info(&packet->as.device_info, body, capacity);
        case MOCAP_KIND_HEALTH:
            return mocap_encode_health(&packet->as.health, body, capacity);
        case MOCAP_KIND_EVENT:
            return mocap_encode_event(&packet->as.event, body, capacity);
        case MOCAP_KIND_LOG_LINE:
            return mocap_encode_log_line(&packet->as.log_line, body, capacity);
        case MOCAP_KIND_SYNC_REQUEST:
            return mocap_encode_sync_request(&packet->as.sync_request, body, capacity);
        case MOCAP_KIND_SYNC_RESPONSE:
            return mocap_encode_sync_response(&packet->as.sync_response, body, capacity);
        case MOCAP_KIND_SAMPLING_TRIGGER:
            return mocap_encode_sampling_trigger(&packet->as.sampling_trigger, body, capacity);
        case MOCAP_KIND_COMMAND:
            return mocap_encode_command(&packet->as.command, body, capacity);
        case MOCAP_KIND_ACKNOWLEDGEMENT:
            return mocap_encode_acknowledgement(&packet->as.acknowledgement, body, capacity);
        case MOCAP_KIND_TRANSFER_TO_MODULE:
            return mocap_encode_transfer_to_module(&packet->as.transfer_to_module, body, capacity);
        case MOCAP_KIND_TRANSFER_TO_HOST:
            return mocap_encode_transfer_to_host(&packet->as.transfer_to_host, body, capacity);
        default:
            return 0u;
    }
}

/* Whether a body of this kind is a packet; a relay batch holds several. */
static inline bool mocap_is_packet(uint8_t kind) {
    switch (kind) {
        case MOCAP_KIND_INERTIAL_SAMPLE:
        case MOCAP_KIND_INERTIAL_SAMPLE_FINE:
        case MOCAP_KIND_FUSED_SAMPLE:
        case MOCAP_KIND_LOCAL_MEASUREMENT:
        case MOCAP_KIND_LIGHT_SAMPLE:
        case MOCAP_KIND_PRESSURE_SAMPLE:
        case MOCAP_KIND_PASS_THROUGH:
        case MOCAP_KIND_DEVICE_INFO:
        case MOCAP_KIND_HEALTH:
        case MOCAP_KIND_EVENT:
        case MOCAP_KIND_LOG_LINE:
        case MOCAP_KIND_SYNC_REQUEST:
        case MOCAP_KIND_SYNC_RESPONSE:
        case MOCAP_KIND_SAMPLING_TRIGGER:
        case MOCAP_KIND_COMMAND:
        case MOCAP_KIND_ACKNOWLEDGEMENT:
        case MOCAP_KIND_TRANSFER_TO_MODULE:
        case MOCAP_KIND_TRANSFER_TO_HOST:
            return true;
        default:
            return false;
    }
}

/* ---- From wire frames to packets ------------------------------------------------------------------ */

/* The packet in a wire frame or in an entry of a relay batch, or why there is none. */
static inline mocap_defect mocap_open_packet(const mocap_wire_frame *frame, mocap_packet *packet) {
    if (!mocap_is_packet(frame->kind)) {
        return MOCAP_UNKNOWN_KIND;
    }
    if (!mocap_is_module_allowed(frame->kind, frame->module)) {
        return MOCAP_BAD_MODULE;
    }
    return mocap_decode_packet(frame->kind, frame->body, frame->body_size, packet);
}

/* ---- Relay batches: wire frames of many modules forwarded as one --------------------------------- */

/* A batch in work; its `body` and `size` become body and body_size of a wire frame of kind
 * MOCAP_KIND_RELAY_BATCH, module MOCAP_RELAY. */
typedef struct {
    uint8_t *body;
    size_t capacity;
    size_t size;
} mocap_relay_batch;

static inline void mocap_relay_begin(mocap_relay_batch *batch, uint8_t *body, size_t capacity) {
    batch->body = body;
    batch->capacity = capacity < MOCAP_MAX_BODY_SIZE ? capacity : MOCAP_MAX_BODY_SIZE;
    batch->size = 0u;
}

/* False, with the batch as it was, when the wire frame cannot be an entry or does not fit any more. */
static inline bool mocap_relay_add(mocap_relay_batch *batch, const mocap_wire_frame *frame) {
    uint8_t *p = batch->body + batch->size;
    if (frame->kind == MOCAP_KIND_RELAY_BATCH || frame->body_size > MOCAP_RELAY_MAX_ENTRY_BODY_SIZE ||
        batch->capacity - batch->size < MOCAP_RELAY_ENTRY_SIZE + frame->body_size) {
        return false;
    }
    p = mocap_put_u8(p, frame->kind);
    p = mocap_put_u8(p, frame->module);
    p = mocap_put_u16(p, frame->sequence);
    p = mocap_put_u32(p, frame->module_time_us);
    p = mocap_put_u8(p, (uint8_t)frame->body_size);
    p = mocap_put_bytes(p, frame->body, frame->body_size);
    batch->size = (size_t)(p - batch->body);
    return true;
}

/* The entry at `*offset` (start with 0), which then moves on to the next. MOCAP_TRUNCATED when it runs
 * past the end of the batch; the entries before it stand. Read on while *offset < body_size. */
static inline mocap_defect mocap_relay_next(const uint8_t *body, size_t body_size, size_t *offset,
                                            mocap_wire_frame *entry) {
    const uint8_t *p = body + *offset;
    const size_t left = body_size - *offset;
    if (left < MOCAP_RELAY_ENTRY_SIZE || left - MOCAP_RELAY_ENTRY_SIZE < p[MOCAP_RELAY_ENTRY_SIZE - 1u]) {
        *offset = body_size;
        return MOCAP_TRUNCATED;
    }
    entry->version = MOCAP_PROTOCOL_VERSION;
    entry->kind = p[0];
    entry->module = p[1];
    entry->sequence = mocap_get_u16(p + 2);
    entry->module_time_us = mocap_get_u32(p + 4);
    entry->body_size = p[MOCAP_RELAY_ENTRY_SIZE - 1u];
    entry->body = p + MOCAP_RELAY_ENTRY_SIZE;
    *offset += MOCAP_RELAY_ENTRY_SIZE + entry->body_size;
    return MOCAP_GOOD;
}

/* ---- Wire frames on a CAN bus, classic and FD ---------------------------------------------------- */

/* One frame of a CAN bus. */
typedef struct {
    uint32_t identifier; /* 29 bits (11 when not is_extended), without flags */
    bool is_extended;
    bool is_remote;
    bool is_error;
    bool is_fd;
    uint8_t length; /* bytes of data: 0 to 8, FD to 64 */
    uint8_t data[64];
} mocap_can_frame;

static inline uint32_t mocap_can_identifier(uint8_t kind, uint8_t module, uint8_t index, bool last) {
    return (uint32_t)mocap_can_priority(kind) << MOCAP_CAN_PRIORITY_SHIFT |
           (uint32_t)kind << MOCAP_CAN_KIND_SHIFT | (uint32_t)module << MOCAP_CAN_MODULE_SHIFT |
           (uint32_t)MOCAP_PROTOCOL_VERSION << MOCAP_CAN_VERSION_SHIFT |
           (uint32_t)(last ? 1u : 0u) << MOCAP_CAN_LAST_SHIFT | (uint32_t)index << MOCAP_CAN_INDEX_SHIFT;
}

/* Smallest length, not below `size`, that a CAN FD frame can have. */
static inline uint8_t mocap_can_fd_length(size_t size) {
    const size_t step = size <= 8u ? 1u : size <= 24u ? 4u : size <= 32u ? 8u : 16u;
    return (uint8_t)((size + step - 1u) / step * step);
}

/* A wire frame on its way into CAN frames. */
typedef struct {
    uint8_t kind;
    uint8_t module;
    bool is_fd;
    uint8_t index;
    uint8_t head[MOCAP_CAN_HEAD_SIZE];
    const uint8_t *body;
    size_t body_size;
    uint8_t checksum[4];
    size_t position; /* in head, body and checksum joined */
} mocap_can_fragmenter;

/* False when the body is too long. `frame->body` must stay until the last piece has been taken. */
static inline bool mocap_can_fragment(mocap_can_fragmenter *fragmenter, const mocap_wire_frame *frame,
        bool is_fd) {
    uint8_t header[MOCAP_HEADER_SIZE];
    if (frame->body_size > (is_fd ? MOCAP_CAN_MAX_BODY_SIZE : MOCAP_CAN_MAX_CLASSIC_BODY_SIZE)) {
        return false;
    }
    mocap_put_header(frame, header);
    fragmenter->kind = frame->kind;
    fragmenter->module = frame->module;
    fragmenter->is_fd = is_fd;
    fragmenter->index = 0u;
    memcpy(fragmenter->head, header + 3, MOCAP_CAN_HEAD_SIZE - 1u);
    fragmenter->head[MOCAP_CAN_HEAD_SIZE - 1u] = (uint8_t)frame->body_size;
    fragmenter->body = frame->body;
    fragmenter->body_size = frame->body_size;
    (void)mocap_put_u32(fragmenter->checksum,
                        mocap_crc32(mocap_crc32(0u, header, sizeof header), frame->body, frame->body_size));
    fragmenter->position = 0u;
    return true;
}

/* Byte of head, body, checksum and padding joined. */
static inline uint8_t mocap_can_byte(const mocap_can_fragmenter *fragmenter, size_t position) {
    if (position < MOCAP_CAN_HEAD_SIZE) {
        return fragmenter->head[position];
    }
    position -= MOCAP_CAN_HEAD_SIZE;
    if (position < fragmenter->body_size) {
        return fragmenter->body[position];
    }
    position -= fragmenter->body_size;
    return position < 4u ? fragmenter->checksum[position] : 0u;
}

/* The next CAN frame to be sent; false when there is none left. */
static inline bool mocap_can_next(mocap_can_fragmenter *fragmenter, mocap_can_frame *piece) {
    const size_t total = MOCAP_CAN_OVERHEAD + fragmenter->body_size;
    const size_t limit = fragmenter->is_fd ? 64u : 8u;
    size_t i, length;
    bool last;
    if (fragmenter->position >= total) {
        return false;
    }
    last = total - fragmenter->position <= limit;
    length = last ? total - fragmenter->position : limit;
    piece->is_extended = true;
    piece->is_remote = false;
    piece->is_error = false;
    piece->is_fd = fragmenter->is_fd;
    piece->identifier = mocap_can_identifier(fragmenter->kind, fragmenter->module, fragmenter->index, last);
    piece->length = fragmenter->is_fd ? mocap_can_fd_length(length) : (uint8_t)length;
    for (i = 0; i < piece->length; ++i) {
        piece->data[i] = mocap_can_byte(fragmenter, fragmenter->position + i);
    }
    fragmenter->position += length;
    ++fragmenter->index;
    return true;
}

#ifndef MOCAP_CAN_BODY_CAPACITY
#define MOCAP_CAN_BODY_CAPACITY MOCAP_CAN_MAX_BODY_SIZE
#endif

/* One wire frame in reassembly. */
typedef struct {
    bool in_use;
    bool spoilt; /* a piece is missing: what is left of the wire frame passes unread */
    uint8_t kind;
    uint8_t module;
    uint8_t pieces;
    size_t size; /* bytes received; more than `payload` holds are counted but not kept */
    uint32_t begun; /* number among all begun, to find the oldest */
    uint8_t payload[MOCAP_CAN_OVERHEAD + MOCAP_CAN_BODY_CAPACITY];
} mocap_can_partial;

/* Reassembles wire frames from CAN frames, those of several senders interleaved. */
typedef struct {
    mocap_can_partial *partial;
    size_t partial_count;
    uint32_t begun;
    uint32_t accepted;
    uint32_t dropped[MOCAP_DEFECTS]; /* by mocap_defect */
} mocap_can_decoder;

/* `partial`: one for each wire frame that may be in reassembly at a time (1 where only the host talks;
 * the one begun longest ago gives way to a new one). */
static inline void mocap_can_decoder_init(mocap_can_decoder *decoder, mocap_can_partial *partial,
        size_t count) {
    memset(decoder, 0, sizeof *decoder);
    memset(partial, 0, count * sizeof *partial);
    decoder->partial = partial;
    decoder->partial_count = count;
}

static inline mocap_can_partial *mocap_can_find(mocap_can_decoder *decoder, uint8_t kind, uint8_t module) {
    size_t i;
    for (i = 0; i < decoder->partial_count; ++i) {
        mocap_can_partial *partial = &decoder->partial[i];
        if (partial->in_use && partial->kind == kind && partial->module == module) {
            return partial;
        }
    }
    return NULL;
}

/* Gives up an unfinished wire frame, which counts unless it has been counted as spoilt. */
static inline void mocap_can_forget(mocap_can_decoder *decoder, mocap_can_partial *partial) {
    if (!partial->spoilt) {
        ++decoder->dropped[MOCAP_LOST_FRAGMENT];
    }
    partial->in_use = false;
}

/* A free place, or that of the wire frame begun longest ago. */
static inline mocap_can_partial *mocap_can_begin(mocap_can_decoder *decoder, uint8_t kind, uint8_t module) {
    mocap_can_partial *chosen = &decoder->partial[0];
    size_t i;
    for (i = 0; i < decoder->partial_count; ++i) {
        mocap_can_partial *partial = &decoder->partial[i];
        if (!partial->in_use) {
            chosen = partial;
            break;
        }
        if (decoder->begun - partial->begun > decoder->begun - chosen->begun) {
            chosen = partial;
        }
    }
    if (chosen->in_use) {
        mocap_can_forget(decoder, chosen);
    }
    chosen->in_use = true;
    chosen->spoilt = false;
    chosen->kind = kind;
    chosen->module = module;
    chosen->pieces = 0u;
    chosen->size = 0u;
    chosen->begun = decoder->begun++;
    return chosen;
}

/* The place to which piece `index` belongs. */
static inline mocap_can_partial *mocap_can_place(mocap_can_decoder *decoder, uint8_t kind, uint8_t module,
                                                 uint8_t index) {
    mocap_can_partial *partial = mocap_can_find(decoder, kind, module);
    if (index == 0u) {
        if (partial != NULL) {
            mocap_can_forget(decoder, partial);
        }
        return mocap_can_begin(decoder, kind, module);
    }
    if (partial != NULL && (partial->spoilt || partial->pieces == index)) {
        return partial;
    }
    ++decoder->dropped[MOCAP_LOST_FRAGMENT];
    if (partial == NULL) {
        partial = mocap_can_begin(decoder, kind, module);
    }
    partial->spoilt = true;
    return partial;
}

/* The wire frame of the joined pieces; its body points into `partial`. */
static inline mocap_defect mocap_can_join(const mocap_can_partial *partial, bool is_fd,
        mocap_wire_frame *frame) {
    const uint8_t *payload = partial->payload;
    uint8_t identity[3];
    size_t end;
    uint32_t crc;
    if (partial->size < MOCAP_CAN_OVERHEAD) {
        return MOCAP_TOO_SHORT;
    }
    frame->body_size = payload[MOCAP_CAN_HEAD_SIZE - 1u];
    end = MOCAP_CAN_OVERHEAD + frame->body_size;
    if (end > sizeof partial->payload || partial->size < end ||
        partial->size - end > (is_fd ? MOCAP_CAN_MAX_PADDING : 0u)) {
        return MOCAP_BAD_LENGTH;
    }
    frame->version = identity[0] = MOCAP_PROTOCOL_VERSION;
    frame->kind = identity[1] = partial->kind;
    frame->module = identity[2] = partial->module;
    frame->sequence = mocap_get_u16(payload);
    frame->module_time_us = mocap_get_u32(payload + 2);
    frame->body = payload + MOCAP_CAN_HEAD_SIZE;
    crc = mocap_crc32(0u, identity, sizeof identity);
    crc = mocap_crc32(crc, payload, MOCAP_CAN_HEAD_SIZE - 1u);
    crc = mocap_crc32(crc, frame->body, frame->body_size);
    return mocap_get_u32(payload + end - 4u) == crc ? MOCAP_GOOD : MOCAP_BAD_CRC;
}

/* True when this CAN frame completes a wire frame; its body is good until the next push. */
static inline bool mocap_can_decoder_push(mocap_can_decoder *decoder, const mocap_can_frame *piece,
                                          mocap_wire_frame *frame) {
    const uint32_t identifier = piece->identifier;
    mocap_can_partial *partial;
    mocap_defect defect;
    if (!piece->is_extended || piece->is_remote || piece->is_error ||
        (identifier >> MOCAP_CAN_VERSION_SHIFT & 15u) != MOCAP_PROTOCOL_VERSION) {
        ++decoder->dropped[MOCAP_FOREIGN];
        return false;
    }
    partial = mocap_can_place(decoder, (uint8_t)(identifier >> MOCAP_CAN_KIND_SHIFT & 0xFFu),
                              (uint8_t)(identifier >> MOCAP_CAN_MODULE_SHIFT & 0xFFu),
                              (uint8_t)(identifier >> MOCAP_CAN_INDEX_SHIFT & 31u));
    if (!partial->spoilt) {
        const size_t kept = partial->size < sizeof partial->payload ? partial->size : sizeof partial->payload;
        const size_t room = sizeof partial->payload - kept;
        memcpy(partial->payload + kept, piece->data, piece->length < room ? piece->length : room);
        partial->size += piece->length;
        ++partial->pieces;
    }
    if ((identifier >> MOCAP_CAN_LAST_SHIFT & 1u) == 0u) {
        return false;
    }
    partial->in_use = false;
    if (partial->spoilt) {
        return false;
    }
    defect = mocap_can_join(partial, piece->is_fd, frame);
    if (defect != MOCAP_GOOD) {
        ++decoder->dropped[defect];
        return false;
    }
    ++decoder->accepted;
    return true;
}

/* ---- Commands: verbs, their arguments and payloads ----------------------------------------------- */

/* What a command asks for. */
typedef enum {
    /* Agree on the protocol version. Always sent, and answered, as version 1. */
    MOCAP_VERB_HELLO = 1,
    /* Blink, to be found. */
    MOCAP_VERB_IDENTIFY = 2,
    /* Answer, then send DeviceInfo and Health. */
    MOCAP_VERB_GET_INFO = 3,
    /* Start sampling. */
    MOCAP_VERB_START = 4,
    /* Stop sampling. */
    MOCAP_VERB_STOP = 5,
    /* Read a setting: the staged value when there is one. */
    MOCAP_VERB_READ_SETTING = 10,
    /* Stage a new value. It reaches the flash with COMMIT; the answer holds it as staged. */
    MOCAP_VERB_WRITE_SETTING = 11,
    /* Store what is staged, all or nothing, and act by it. */
    MOCAP_VERB_COMMIT = 12,
    /* Forget what is staged. */
    MOCAP_VERB_DISCARD = 13,
    /* Commit the factory value of every setting. */
    MOCAP_VERB_FACTORY_RESET = 14,
    /* List the files on the card, as many as fit the answer. */
    MOCAP_VERB_CARD_LIST = 20,
    /* Read a piece of a file. */
    MOCAP_VERB_CARD_READ = 21,
    /* Erase a file. */
    MOCAP_VERB_CARD_ERASE = 22
} mocap_verb;

/* How a command ended. */
typedef enum {
    MOCAP_RESULT_DONE = 0,
    MOCAP_RESULT_UNKNOWN_VERB = 1,
    MOCAP_RESULT_BAD_ARGUMENTS = 2,
    MOCAP_RESULT_REFUSED = 3,
    MOCAP_RESULT_BUSY = 4,
    MOCAP_RESULT_FLASH_FAILED = 5,
    MOCAP_RESULT_NO_SUCH_SETTING = 6,
    MOCAP_RESULT_NO_SUCH_FILE = 7,
    MOCAP_RESULT_NOTHING_STAGED = 8,
    MOCAP_RESULT_NOT_SUPPORTED = 9
} mocap_result;

/* Whether the device keeps what the verb changes; refused while writes are locked. */
static inline bool mocap_verb_changes_device(uint8_t verb) {
    switch (verb) {
        case MOCAP_VERB_WRITE_SETTING:
        case MOCAP_VERB_COMMIT:
        case MOCAP_VERB_FACTORY_RESET:
        case MOCAP_VERB_CARD_ERASE:
            return true;
        default:
            return false;
    }
}

#define MOCAP_HELLO_ARGUMENTS_MIN_SIZE 2u
#define MOCAP_HELLO_ARGUMENTS_MAX_SIZE 2u

/* Arguments of hello. */
typedef struct {
    /* Lowest protocol version that the host speaks. */
    uint8_t min_version;
    /* Highest. */
    uint8_t max_version;
} mocap_hello_arguments;

static inline size_t mocap_encode_hello_arguments(const mocap_hello_arguments *packet, uint8_t *body, size_t
        capacity) {
    const size_t size = 2u;
    uint8_t *p = body;
    if (size > capacity) {
        return 0u;
    }
    p = mocap_put_u8(p, packet->min_version);
    p = mocap_put_u8(p, packet->max_version);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_hello_arguments(const uint8_t *body, size_t size,
        mocap_hello_arguments *packet) {
    const uint8_t *p = body;
    if (size != 2u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->min_version = mocap_get_u8(p);
    p += 1u;
    packet->max_version = mocap_get_u8(p);
    p += 1u;
    (void)p;
    return MOCAP_GOOD;
}

#define MOCAP_HELLO_PAYLOAD_MIN_SIZE 3u
#define MOCAP_HELLO_PAYLOAD_MAX_SIZE 3u

/* Payload of hello. */
typedef struct {
    /* Version to be spoken from now on: the highest that both know; 0: none. */
    uint8_t chosen;
    /* Lowest protocol version that the device speaks. */
    uint8_t min_version;
    /* Highest. */
    uint8_t max_version;
} mocap_hello_payload;

static inline size_t mocap_encode_hello_payload(const mocap_hello_payload *packet, uint8_t *body, size_t
        capacity) {
    const size_t size = 3u;
    uint8_t *p = body;
    if (size > capacity) {
        return 0u;
    }
    p = mocap_put_u8(p, packet->chosen);
    p = mocap_put_u8(p, packet->min_version);
    p = mocap_put_u8(p, packet->max_version);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_hello_payload(const uint8_t *body, size_t size, mocap_hello_payload
        *packet) {
    const uint8_t *p = body;
    if (size != 3u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->chosen = mocap_get_u8(p);
    p += 1u;
    packet->min_version = mocap_get_u8(p);
    p += 1u;
    packet->max_version = mocap_get_u8(p);
    p += 1u;
    (void)p;
    return MOCAP_GOOD;
}

#define MOCAP_IDENTIFY_ARGUMENTS_MIN_SIZE 1u
#define MOCAP_IDENTIFY_ARGUMENTS_MAX_SIZE 1u

/* Arguments of identify. */
typedef struct {
    /* How long; 0 stops it. In s. */
    uint8_t seconds;
} mocap_identify_arguments;

static inline size_t mocap_encode_identify_arguments(const mocap_identify_arguments *packet, uint8_t *body,
        size_t capacity) {
    const size_t size = 1u;
    uint8_t *p = body;
    if (size > capacity) {
        return 0u;
    }
    p = mocap_put_u8(p, packet->seconds);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_identify_arguments(const uint8_t *body, size_t size,
        mocap_identify_arguments *packet) {
    const uint8_t *p = body;
    if (size != 1u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->seconds = mocap_get_u8(p);
    p += 1u;
    (void)p;
    return MOCAP_GOOD;
}

#define MOCAP_READ_SETTING_ARGUMENTS_MIN_SIZE 1u
#define MOCAP_READ_SETTING_ARGUMENTS_MAX_SIZE 1u

/* Arguments of read_setting. */
typedef struct {
    /* Which setting, as listed under "Settings". */
    uint8_t key;
} mocap_read_setting_arguments;

static inline size_t mocap_encode_read_setting_arguments(const mocap_read_setting_arguments *packet, uint8_t
        *body, size_t capacity) {
    const size_t size = 1u;
    uint8_t *p = body;
    if (size > capacity) {
        return 0u;
    }
    p = mocap_put_u8(p, packet->key);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_read_setting_arguments(const uint8_t *body, size_t size,
        mocap_read_setting_arguments *packet) {
    const uint8_t *p = body;
    if (size != 1u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->key = mocap_get_u8(p);
    p += 1u;
    (void)p;
    return MOCAP_GOOD;
}

#define MOCAP_READ_SETTING_PAYLOAD_MIN_SIZE 1u
#define MOCAP_READ_SETTING_PAYLOAD_MAX_SIZE 200u

/* Payload of read_setting. */
typedef struct {
    /* Which setting, as listed under "Settings". */
    uint8_t key;
    /* As the setting declares. 0 to 199 bytes. */
    const uint8_t *value;
    size_t value_size;
} mocap_read_setting_payload;

static inline size_t mocap_encode_read_setting_payload(const mocap_read_setting_payload *packet, uint8_t
        *body, size_t capacity) {
    const size_t size = 1u + packet->value_size;
    uint8_t *p = body;
    if (packet->value_size > 199u) {
        return 0u;
    }
    if (size > capacity) {
        return 0u;
    }
    p = mocap_put_u8(p, packet->key);
    p = mocap_put_bytes(p, packet->value, packet->value_size);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_read_setting_payload(const uint8_t *body, size_t size,
        mocap_read_setting_payload *packet) {
    const uint8_t *p = body;
    if (size < 1u || size > 200u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->key = mocap_get_u8(p);
    p += 1u;
    packet->value = p;
    packet->value_size = size - (size_t)(p - body);
    return MOCAP_GOOD;
}

#define MOCAP_WRITE_SETTING_ARGUMENTS_MIN_SIZE 1u
#define MOCAP_WRITE_SETTING_ARGUMENTS_MAX_SIZE 200u

/* Arguments of write_setting. */
typedef struct {
    /* Which setting, as listed under "Settings". */
    uint8_t key;
    /* As the setting declares. 0 to 199 bytes. */
    const uint8_t *value;
    size_t value_size;
} mocap_write_setting_arguments;

static inline size_t mocap_encode_write_setting_arguments(const mocap_write_setting_arguments *packet, uint8_t
        *body, size_t capacity) {
    const size_t size = 1u + packet->value_size;
    uint8_t *p = body;
    if (packet->value_size > 199u) {
        return 0u;
    }
    if (size > capacity) {
        return 0u;
    }
    p = mocap_put_u8(p, packet->key);
    p = mocap_put_bytes(p, packet->value, packet->value_size);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_write_setting_arguments(const uint8_t *body, size_t size,
        mocap_write_setting_arguments *packet) {
    const uint8_t *p = body;
    if (size < 1u || size > 200u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->key = mocap_get_u8(p);
    p += 1u;
    packet->value = p;
    packet->value_size = size - (size_t)(p - body);
    return MOCAP_GOOD;
}

#define MOCAP_WRITE_SETTING_PAYLOAD_MIN_SIZE 1u
#define MOCAP_WRITE_SETTING_PAYLOAD_MAX_SIZE 200u

/* Payload of write_setting. */
typedef struct {
    /* Which setting, as listed under "Settings". */
    uint8_t key;
    /* As the setting declares. 0 to 199 bytes. */
    const uint8_t *value;
    size_t value_size;
} mocap_write_setting_payload;

static inline size_t mocap_encode_write_setting_payload(const mocap_write_setting_payload *packet, uint8_t
        *body, size_t capacity) {
    const size_t size = 1u + packet->value_size;
    uint8_t *p = body;
    if (packet->value_size > 199u) {
        return 0u;
    }
    if (size > capacity) {
        return 0u;
    }
    p = mocap_put_u8(p, packet->key);
    p = mocap_put_bytes(p, packet->value, packet->value_size);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_write_setting_payload(const uint8_t *body, size_t size,
        mocap_write_setting_payload *packet) {
    const uint8_t *p = body;
    if (size < 1u || size > 200u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->key = mocap_get_u8(p);
    p += 1u;
    packet->value = p;
    packet->value_size = size - (size_t)(p - body);
    return MOCAP_GOOD;
}

#define MOCAP_COMMIT_PAYLOAD_MIN_SIZE 4u
#define MOCAP_COMMIT_PAYLOAD_MAX_SIZE 4u

/* Payload of commit. */
typedef struct {
    /* Generation of the slot that now holds the settings. */
    uint32_t generation;
} mocap_commit_payload;

static inline size_t mocap_encode_commit_payload(const mocap_commit_payload *packet, uint8_t *body, size_t
        capacity) {
    const size_t size = 4u;
    uint8_t *p = body;
    if (size > capacity) {
        return 0u;
    }
    p = mocap_put_u32(p, packet->generation);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_commit_payload(const uint8_t *body, size_t size, mocap_commit_payload
        *packet) {
    const uint8_t *p = body;
    if (size != 4u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->generation = mocap_get_u32(p);
    p += 4u;
    (void)p;
    return MOCAP_GOOD;
}

#define MOCAP_FACTORY_RESET_ARGUMENTS_MAGIC_MIN 1178682196u
#define MOCAP_FACTORY_RESET_ARGUMENTS_MAGIC_MAX 1178682196u
#define MOCAP_FACTORY_RESET_ARGUMENTS_MIN_SIZE 4u
#define MOCAP_FACTORY_RESET_ARGUMENTS_MAX_SIZE 4u

/* Arguments of factory_reset. */
typedef struct {
    /* Only 0x46414354 (the letters FACT) is obeyed. From 1178682196 to 1178682196 steps. */
    uint32_t magic;
} mocap_factory_reset_arguments;

/* Whether every field has a value that it allows. */
static inline bool mocap_factory_reset_arguments_is_valid(const mocap_factory_reset_arguments *packet) {
    if (packet->magic < 1178682196u || packet->magic > 1178682196u) {
        return false;
    }
    return true;
}

static inline size_t mocap_encode_factory_reset_arguments(const mocap_factory_reset_arguments *packet, uint8_t
        *body, size_t capacity) {
    const size_t size = 4u;
    uint8_t *p = body;
    if (size > capacity || !mocap_factory_reset_arguments_is_valid(packet)) {
        return 0u;
    }
    p = mocap_put_u32(p, packet->magic);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_factory_reset_arguments(const uint8_t *body, size_t size,
        mocap_factory_reset_arguments *packet) {
    const uint8_t *p = body;
    if (size != 4u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->magic = mocap_get_u32(p);
    p += 4u;
    (void)p;
    return mocap_factory_reset_arguments_is_valid(packet) ? MOCAP_GOOD : MOCAP_BAD_VALUE;
}

#define MOCAP_CARD_LIST_ARGUMENTS_MIN_SIZE 2u
#define MOCAP_CARD_LIST_ARGUMENTS_MAX_SIZE 2u

/* Arguments of card_list. */
typedef struct {
    /* Place in the list to begin at, from 0. */
    uint16_t first;
} mocap_card_list_arguments;

static inline size_t mocap_encode_card_list_arguments(const mocap_card_list_arguments *packet, uint8_t *body,
        size_t capacity) {
    const size_t size = 2u;
    uint8_t *p = body;
    if (size > capacity) {
        return 0u;
    }
    p = mocap_put_u16(p, packet->first);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_card_list_arguments(const uint8_t *body, size_t size,
        mocap_card_list_arguments *packet) {
    const uint8_t *p = body;
    if (size != 2u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->first = mocap_get_u16(p);
    p += 2u;
    (void)p;
    return MOCAP_GOOD;
}

#define MOCAP_CARD_LIST_PAYLOAD_MIN_SIZE 2u
#define MOCAP_CARD_LIST_PAYLOAD_MAX_SIZE 2u

/* Payload of card_list, before its entries. */
typedef struct {
    /* Files on the card. */
    uint16_t total;
} mocap_card_list_payload;

static inline size_t mocap_encode_card_list_payload(const mocap_card_list_payload *packet, uint8_t *body,
        size_t capacity) {
    const size_t size = 2u;
    uint8_t *p = body;
    if (size > capacity) {
        return 0u;
    }
    p = mocap_put_u16(p, packet->total);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_card_list_payload(const uint8_t *body, size_t size,
        mocap_card_list_payload *packet) {
    const uint8_t *p = body;
    if (size != 2u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->total = mocap_get_u16(p);
    p += 2u;
    (void)p;
    return MOCAP_GOOD;
}

#define MOCAP_CARD_LIST_ENTRY_MIN_SIZE 14u
#define MOCAP_CARD_LIST_ENTRY_MAX_SIZE 14u

/* One of at most 14 entries in the payload of card_list. */
typedef struct {
    /* Number of the file. */
    uint16_t file;
    /* Bytes of the file. In bytes. */
    uint32_t size;
    /* Module's clock at the first sample. In us. */
    uint32_t start_time_us;
    /* CRC-32 of the whole file. */
    uint32_t crc32;
} mocap_card_list_entry;

static inline size_t mocap_encode_card_list_entry(const mocap_card_list_entry *packet, uint8_t *body, size_t
        capacity) {
    const size_t size = 14u;
    uint8_t *p = body;
    if (size > capacity) {
        return 0u;
    }
    p = mocap_put_u16(p, packet->file);
    p = mocap_put_u32(p, packet->size);
    p = mocap_put_u32(p, packet->start_time_us);
    p = mocap_put_u32(p, packet->crc32);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_card_list_entry(const uint8_t *body, size_t size,
        mocap_card_list_entry *packet) {
    const uint8_t *p = body;
    if (size != 14u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->file = mocap_get_u16(p);
    p += 2u;
    packet->size = mocap_get_u32(p);
    p += 4u;
    packet->start_time_us = mocap_get_u32(p);
    p += 4u;
    packet->crc32 = mocap_get_u32(p);
    p += 4u;
    (void)p;
    return MOCAP_GOOD;
}

#define MOCAP_CARD_READ_ARGUMENTS_LENGTH_MIN 0u
#define MOCAP_CARD_READ_ARGUMENTS_LENGTH_MAX 192u
#define MOCAP_CARD_READ_ARGUMENTS_MIN_SIZE 7u
#define MOCAP_CARD_READ_ARGUMENTS_MAX_SIZE 7u

/* Arguments of card_read. */
typedef struct {
    /* Number of the file. */
    uint16_t file;
    /* First byte of the piece. In bytes. */
    uint32_t offset;
    /* Bytes wanted. In bytes. From 0 to 192 steps. */
    uint8_t length;
} mocap_card_read_arguments;

/* Whether every field has a value that it allows. */
static inline bool mocap_card_read_arguments_is_valid(const mocap_card_read_arguments *packet) {
    if (packet->length > 192u) {
        return false;
    }
    return true;
}

static inline size_t mocap_encode_card_read_arguments(const mocap_card_read_arguments *packet, uint8_t *body,
        size_t capacity) {
    const size_t size = 7u;
    uint8_t *p = body;
    if (size > capacity || !mocap_card_read_arguments_is_valid(packet)) {
        return 0u;
    }
    p = mocap_put_u16(p, packet->file);
    p = mocap_put_u32(p, packet->offset);
    p = mocap_put_u8(p, packet->length);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_card_read_arguments(const uint8_t *body, size_t size,
        mocap_card_read_arguments *packet) {
    const uint8_t *p = body;
    if (size != 7u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->file = mocap_get_u16(p);
    p += 2u;
    packet->offset = mocap_get_u32(p);
    p += 4u;
    packet->length = mocap_get_u8(p);
    p += 1u;
    (void)p;
    return mocap_card_read_arguments_is_valid(packet) ? MOCAP_GOOD : MOCAP_BAD_VALUE;
}

#define MOCAP_CARD_READ_PAYLOAD_MIN_SIZE 6u
#define MOCAP_CARD_READ_PAYLOAD_MAX_SIZE 198u

/* Payload of card_read. */
typedef struct {
    /* Number of the file. */
    uint16_t file;
    /* First byte of the piece. In bytes. */
    uint32_t offset;
    /* Shorter than asked for at the file's end. 0 to 192 bytes. */
    const uint8_t *data;
    size_t data_size;
} mocap_card_read_payload;

static inline size_t mocap_encode_card_read_payload(const mocap_card_read_payload *packet, uint8_t *body,
        size_t capacity) {
    const size_t size = 6u + packet->data_size;
    uint8_t *p = body;
    if (packet->data_size > 192u) {
        return 0u;
    }
    if (size > capacity) {
        return 0u;
    }
    p = mocap_put_u16(p, packet->file);
    p = mocap_put_u32(p, packet->offset);
    p = mocap_put_bytes(p, packet->data, packet->data_size);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_card_read_payload(const uint8_t *body, size_t size,
        mocap_card_read_payload *packet) {
    const uint8_t *p = body;
    if (size < 6u || size > 198u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->file = mocap_get_u16(p);
    p += 2u;
    packet->offset = mocap_get_u32(p);
    p += 4u;
    packet->data = p;
    packet->data_size = size - (size_t)(p - body);
    return MOCAP_GOOD;
}

#define MOCAP_CARD_ERASE_ARGUMENTS_MIN_SIZE 2u
#define MOCAP_CARD_ERASE_ARGUMENTS_MAX_SIZE 2u

/* Arguments of card_erase. */
typedef struct {
    /* Number of the file; 65535: all of them. */
    uint16_t file;
} mocap_card_erase_arguments;

static inline size_t mocap_encode_card_erase_arguments(const mocap_card_erase_arguments *packet, uint8_t
        *body, size_t capacity) {
    const size_t size = 2u;
    uint8_t *p = body;
    if (size > capacity) {
        return 0u;
    }
    p = mocap_put_u16(p, packet->file);
    return (size_t)(p - body);
}

static inline mocap_defect mocap_decode_card_erase_arguments(const uint8_t *body, size_t size,
        mocap_card_erase_arguments *packet) {
    const uint8_t *p = body;
    if (size != 2u) {
        return MOCAP_BAD_LENGTH;
    }
    memset(packet, 0, sizeof *packet);
    packet->file = mocap_get_u16(p);
    p += 2u;
    (void)p;
    return MOCAP_GOOD;
}

/* ---- Obeying commands ---------------------------------------------------------------------------- */

static inline bool mocap_is_anyone(const uint8_t unique_id[MOCAP_UNIQUE_ID_SIZE]) {
    size_t i;
    for (i = 0; i < MOCAP_UNIQUE_ID_SIZE; ++i) {
        if (unique_id[i] != 0u) {
            return false;
        }
    }
    return true;
}

/* Whether the device is to act: by unique id when the command names one, else by the header's module. */
static inline bool mocap_command_is_for(const mocap_command *command, uint8_t header_module,
        uint8_t own_module,
                                        const uint8_t own_unique_id[MOCAP_UNIQUE_ID_SIZE]) {
    if (mocap_is_anyone(command->unique_id)) {
        return header_module == own_module || header_module == MOCAP_BROADCAST;
    }
    return memcmp(command->unique_id, own_unique_id, MOCAP_UNIQUE_ID_SIZE) == 0;
}

/* How long to wait before answering, so that the answers to a broadcast do not collide, us. */
static inline uint32_t mocap_answer_delay_us(const mocap_command *command, uint8_t header_module,
                                             uint8_t own_module) {
    const bool is_shared = header_module == MOCAP_BROADCAST && mocap_is_anyone(command->unique_id);
    return is_shared ? MOCAP_BROADCAST_ANSWER_DELAY_US * (uint32_t)own_module : 0u;
}

/* The highest protocol version that the host and this header speak; MOCAP_NO_VERSION when there is none. */
static inline uint8_t mocap_negotiate(uint8_t min_version, uint8_t max_version) {
    const uint8_t lowest = min_version > MOCAP_LOWEST_VERSION ? min_version : MOCAP_LOWEST_VERSION;
    const uint8_t highest = max_version < MOCAP_HIGHEST_VERSION ? max_version : MOCAP_HIGHEST_VERSION;
    return lowest <= highest ? highest : MOCAP_NO_VERSION;
}

/* An answer that has been given: the body of its acknowledgement. */
typedef struct {
    uint16_t transaction;
    uint8_t verb;
    size_t size; /* 0: nothing remembered here */
    uint8_t body[MOCAP_ACKNOWLEDGEMENT_MAX_SIZE];
} mocap_answer;

/* The last answers, to be repeated when a command comes again. Begin with all zeros. */
typedef struct {
    mocap_answer answers[MOCAP_ANSWER_MEMORY];
    uint8_t next;
} mocap_answer_memory;

/* The answer to a command that has been obeyed; send it again and do not act. NULL: the command is new. */
static inline const mocap_answer *mocap_find_answer(const mocap_answer_memory *memory, uint16_t transaction,
                                                    uint8_t verb) {
    size_t i;
    for (i = 0; i < MOCAP_ANSWER_MEMORY; ++i) {
        const mocap_answer *answer = &memory->answers[i];
        if (answer->size > 0u && answer->transaction == transaction && answer->verb == verb) {
            return answer;
        }
    }
    return NULL;
}

/* Encodes and remembers an answer in the place of the oldest; NULL when it cannot be sent. */
static inline const mocap_answer *mocap_remember_answer(mocap_answer_memory *memory,
                                                        const mocap_acknowledgement *acknowledgement) {
    mocap_answer *answer = &memory->answers[memory->next];
    answer->size = mocap_encode_acknowledgement(acknowledgement, answer->body, sizeof answer->body);
    if (answer->size == 0u) {
        return NULL;
    }
    answer->transaction = acknowledgement->transaction;
    answer->verb = acknowledgement->verb;
    memory->next = (uint8_t)((memory->next + 1u) % MOCAP_ANSWER_MEMORY);
    return answer;
}

/* ---- Settings ------------------------------------------------------------------------------------ */

#define MOCAP_SETTINGS_MODULE_ID_MIN 0u
#define MOCAP_SETTINGS_MODULE_ID_MAX 63u
#define MOCAP_SETTINGS_SAMPLING_RATE_MIN 10u
#define MOCAP_SETTINGS_SAMPLING_RATE_MAX 40000u
#define MOCAP_SETTINGS_ACCELEROMETER_RANGE_MIN 100u
#define MOCAP_SETTINGS_ACCELEROMETER_RANGE_MAX 4000u
#define MOCAP_SETTINGS_GYROSCOPE_RANGE_MIN 15u
#define MOCAP_SETTINGS_GYROSCOPE_RANGE_MAX 4000u
#define MOCAP_SETTINGS_MAGNETOMETER_RANGE_MIN 100u
#define MOCAP_SETTINGS_MAGNETOMETER_RANGE_MAX 10000u
#define MOCAP_SETTINGS_ACCELEROMETER_LOW_PASS_MIN 0u
#define MOCAP_SETTINGS_ACCELEROMETER_LOW_PASS_MAX 40000u
#define MOCAP_SETTINGS_GYROSCOPE_LOW_PASS_MIN 0u
#define MOCAP_SETTINGS_GYROSCOPE_LOW_PASS_MAX 40000u
#define MOCAP_SETTINGS_MODE_ORIENTATION_FUSED_ON_THE_MODULE 1u
#define MOCAP_SETTINGS_MODE_RAW_SAMPLES_ON_THE_MODULE_S_OWN_TIMER 2u
#define MOCAP_SETTINGS_MODE_RAW_SAMPLES_ON_THE_HOST_S_TRIGGER 3u
#define MOCAP_SETTINGS_MIN_SIZE 150u
#define MOCAP_SETTINGS_MAX_SIZE 150u

/* Everything that a module can be told to keep. */
typedef struct {
    /* Id under which the module sends, unique in a suit. From 0 to 63 steps. */
    uint8_t module_id;
    /* Samples of accelerometer and gyroscope each second. One step is 0.1 Hz. From 10 to 40000
     * steps. */
    uint16_t sampling_rate;
    /* Largest specific force of an axis; the sensor takes the nearest range that holds it. One step
     * is 0.1 m/s^2. From 100 to 4000 steps. */
    uint16_t accelerometer_range;
    /* Largest angular rate of an axis; one step is 1 deg/s. One step is 0.0174532925 rad/s. From 15
     * to 4000 steps. */
    uint16_t gyroscope_range;
    /* Largest magnetic field of an axis. One step is 1 uT. From 100 to 10000 steps. */
    uint16_t magnetometer_range;
    /* Cut-off frequency of the sensor's own filter; 0 turns it off. One step is 0.1 Hz. From 0 to
     * 40000 steps. */
    uint16_t accelerometer_low_pass;
    /* Cut-off frequency of the sensor's own filter; 0 turns it off. One step is 0.1 Hz. From 0 to
     * 40000 steps. */
    uint16_t gyroscope_low_pass;
    /* What the module sends. 1 orientation fused on the module; 2 raw samples on the module's own
     * timer; 3 raw samples on the host's trigger. */
    uint8_t mode;
    /* Accelerometer matrix (3x3, row after row) and bias (3, m/s^2); gyroscope bias (3, rad/s);
     * magnetometer soft iron (3x3) and hard iron (3, uT); temperature of calibration (degC);
     * reserved (2). */
    float calibration[30];
    /* A name for people. UTF-8, zeros after its end. */
    uint8_t label[16];
} mocap_settings;

/* Key of each. */
typedef enum {
    MOCAP_SETTING_MODULE_ID = 1,
    MOCAP_SETTING_SAMPLING_RATE = 2,
    MOCAP_SETTING_ACCELEROMETER_RANGE = 3,
    MOCAP_SETTING_GYROSCOPE_RANGE = 4,
    MOCAP_SETTING_MAGNETOMETER_RANGE = 5,
    MOCAP_SETTING_ACCELEROMETER_LOW_PASS = 6,
    MOCAP_SETTING_GYROSCOPE_LOW_PASS = 7,
    MOCAP_SETTING_MODE = 8,
    MOCAP_SETTING_CALIBRATION = 9,
    MOCAP_SETTING_LABEL = 10
} mocap_setting;

#define MOCAP_SETTINGS 10u /* how many there are */
#define MOCAP_MAX_SETTING_SIZE 120u /* bytes of the largest value */

/* Key of the i-th setting, in rising order. */
static inline uint8_t mocap_setting_key(size_t i) {
    static const uint8_t keys[MOCAP_SETTINGS] = {1u, 2u, 3u, 4u, 5u, 6u, 7u, 8u, 9u, 10u};
    return keys[i];
}

/* Whether every field has a value that it allows. */
static inline bool mocap_settings_is_valid(const mocap_settings *packet) {
    size_t i;
    if (packet->module_id > 63u) {
        return false;
    }
    if (packet->sampling_rate < 10u || packet->sampling_rate > 40000u) {
        return false;
    }
    if (packet->accelerometer_range < 100u || packet->accelerometer_range > 4000u) {
        return false;
    }
    if (packet->gyroscope_range < 15u || packet->gyroscope_range > 4000u) {
        return false;
    }
    if (packet->magnetometer_range < 100u || packet->magnetometer_range > 10000u) {
        return false;
    }
    if (packet->accelerometer_low_pass > 40000u) {
        return false;
    }
    if (packet->gyroscope_low_pass > 40000u) {
        return false;
    }
    if (packet->mode < 1u || packet->mode > 3u) {
        return false;
    }
    for (i = 0; i < 30u; ++i) {
        if (!mocap_is_finite(packet->calibration[i])) {
            return false;
        }
    }
    if (!mocap_is_padded_text(packet->label, 16u)) {
        return false;
    }
    return true;
}

/* The settings with which a module leaves the factory. */
static inline void mocap_settings_set_factory(mocap_settings *settings) {
    memset(settings, 0, sizeof *settings);
    settings->sampling_rate = 1000u;
    settings->accelerometer_range = 1569u;
    settings->gyroscope_range = 2000u;
    settings->magnetometer_range = 4900u;
    settings->mode = 2u;
    settings->calibration[0] = 1.0f;
    settings->calibration[4] = 1.0f;
    settings->calibration[8] = 1.0f;
    settings->calibration[15] = 1.0f;
    settings->calibration[19] = 1.0f;
    settings->calibration[23] = 1.0f;
    settings->calibration[27] = 25.0f;
}

/* The bytes of one setting; 0 for a key that there is not. */
static inline size_t mocap_settings_read(const mocap_settings *settings, uint8_t key, uint8_t *value, size_t
        capacity) {
    uint8_t *p = value;
    size_t i;
    switch (key) {
        case MOCAP_SETTING_MODULE_ID:
            if (capacity < 1u) {
                return 0u;
            }
            p = mocap_put_u8(p, settings->module_id);
            break;
        case MOCAP_SETTING_SAMPLING_RATE:
            if (capacity < 2u) {
                return 0u;
            }
            p = mocap_put_u16(p, settings->sampling_rate);
            break;
        case MOCAP_SETTING_ACCELEROMETER_RANGE:
            if (capacity < 2u) {
                return 0u;
            }
            p = mocap_put_u16(p, settings->accelerometer_range);
            break;
        case MOCAP_SETTING_GYROSCOPE_RANGE:
            if (capacity < 2u) {
                return 0u;
            }
            p = mocap_put_u16(p, settings->gyroscope_range);
            break;
        case MOCAP_SETTING_MAGNETOMETER_RANGE:
            if (capacity < 2u) {
                return 0u;
            }
            p = mocap_put_u16(p, settings->magnetometer_range);
            break;
        case MOCAP_SETTING_ACCELEROMETER_LOW_PASS:
            if (capacity < 2u) {
                return 0u;
            }
            p = mocap_put_u16(p, settings->accelerometer_low_pass);
            break;
        case MOCAP_SETTING_GYROSCOPE_LOW_PASS:
            if (capacity < 2u) {
                return 0u;
            }
            p = mocap_put_u16(p, settings->gyroscope_low_pass);
            break;
        case MOCAP_SETTING_MODE:
            if (capacity < 1u) {
                return 0u;
            }
            p = mocap_put_u8(p, settings->mode);
            break;
        case MOCAP_SETTING_CALIBRATION:
            if (capacity < 120u) {
                return 0u;
            }
            for (i = 0; i < 30u; ++i) {
                p = mocap_put_f32(p, settings->calibration[i]);
            }
            break;
        case MOCAP_SETTING_LABEL:
            if (capacity < 16u) {
                return 0u;
            }
            p = mocap_put_bytes(p, settings->label, 16u);
            break;
        default:
            return 0u;
    }
    return (size_t)(p - value);
}

/* Takes one setting from bytes; what is no value of it is refused and changes nothing. */
static inline mocap_result mocap_settings_write(mocap_settings *settings, uint8_t key, const uint8_t *value,
        size_t size) {
    const uint8_t *p = value;
    switch (key) {
        case MOCAP_SETTING_MODULE_ID: {
            uint8_t v;
            if (size != 1u) {
                return MOCAP_RESULT_BAD_ARGUMENTS;
            }
            v = mocap_get_u8(p);
            if (v > 63u) {
                return MOCAP_RESULT_BAD_ARGUMENTS;
            }
            settings->module_id = v;
            return MOCAP_RESULT_DONE;
        }
        case MOCAP_SETTING_SAMPLING_RATE: {
            uint16_t v;
            if (size != 2u) {
                return MOCAP_RESULT_BAD_ARGUMENTS;
            }
            v = mocap_get_u16(p);
            if (v < 10u || v > 40000u) {
                return MOCAP_RESULT_BAD_ARGUMENTS;
            }
            settings->sampling_rate = v;
            return MOCAP_RESULT_DONE;
        }
        case MOCAP_SETTING_ACCELEROMETER_RANGE: {
            uint16_t v;
            if (size != 2u) {
                return MOCAP_RESULT_BAD_ARGUMENTS;
            }
            v = mocap_get_u16(p);
            if (v < 100u || v > 4000u) {
                return MOCAP_RESULT_BAD_ARGUMENTS;
            }
            settings->accelerometer_range = v;
            return MOCAP_RESULT_DONE;
        }
        case MOCAP_SETTING_GYROSCOPE_RANGE: {
            uint16_t v;
            if (size != 2u) {
                return MOCAP_RESULT_BAD_ARGUMENTS;
            }
            v = mocap_get_u16(p);
            if (v < 15u || v > 4000u) {
                return MOCAP_RESULT_BAD_ARGUMENTS;
            }
            settings->gyroscope_range = v;
            return MOCAP_RESULT_DONE;
        }
        case MOCAP_SETTING_MAGNETOMETER_RANGE: {
            uint16_t v;
            if (size != 2u) {
                return MOCAP_RESULT_BAD_ARGUMENTS;
            }
            v = mocap_get_u16(p);
            if (v < 100u || v > 10000u) {
                return MOCAP_RESULT_BAD_ARGUMENTS;
            }
            settings->magnetometer_range = v;
            return MOCAP_RESULT_DONE;
        }
        case MOCAP_SETTING_ACCELEROMETER_LOW_PASS: {
            uint16_t v;
            if (size != 2u) {
                return MOCAP_RESULT_BAD_ARGUMENTS;
            }
            v = mocap_get_u16(p);
            if (v > 40000u) {
                return MOCAP_RESULT_BAD_ARGUMENTS;
            }
            settings->accelerometer_low_pass = v;
            return MOCAP_RESULT_DONE;
        }
        case MOCAP_SETTING_GYROSCOPE_LOW_PASS: {
            uint16_t v;
            if (size != 2u) {
                return MOCAP_RESULT_BAD_ARGUMENTS;
            }
            v = mocap_get_u16(p);
            if (v > 40000u) {
                return MOCAP_RESULT_BAD_ARGUMENTS;
            }
            settings->gyroscope_low_pass = v;
            return MOCAP_RESULT_DONE;
        }
        case MOCAP_SETTING_MODE: {
            uint8_t v;
            if (size != 1u) {
                return MOCAP_RESULT_BAD_ARGUMENTS;
            }
            v = mocap_get_u8(p);
            if (v < 1u || v > 3u) {
                return MOCAP_RESULT_BAD_ARGUMENTS;
            }
            settings->mode = v;
            return MOCAP_RESULT_DONE;
        }
        case MOCAP_SETTING_CALIBRATION: {
            float v[30];
            size_t i;
            if (size != 120u) {
                return MOCAP_RESULT_BAD_ARGUMENTS;
            }
            for (i = 0; i < 30u; ++i) {
                v[i] = mocap_get_f32(p);
                p += 4u;
            }
            for (i = 0; i < 30u; ++i) {
                if (!mocap_is_finite(v[i])) {
                    return MOCAP_RESULT_BAD_ARGUMENTS;
                }
            }
            memcpy(settings->calibration, v, sizeof v);
            return MOCAP_RESULT_DONE;
        }
        case MOCAP_SETTING_LABEL: {
            if (size != 16u) {
                return MOCAP_RESULT_BAD_ARGUMENTS;
            }
            if (!mocap_is_padded_text(p, 16u)) {
                return MOCAP_RESULT_BAD_ARGUMENTS;
            }
            memcpy(settings->label, p, 16u);
            return MOCAP_RESULT_DONE;
        }
        default:
            return MOCAP_RESULT_NO_SUCH_SETTING;
    }
}

/* Between steps and Hz; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_settings_sampling_rate_to_si(uint16_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)0.1;
}

static inline uint16_t mocap_settings_sampling_rate_from_si(MOCAP_REAL value) {
    return (uint16_t)mocap_nearest_unsigned(value / (MOCAP_REAL)0.1, 10u, 40000u);
}

/* Between steps and m/s^2; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_settings_accelerometer_range_to_si(uint16_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)0.1;
}

static inline uint16_t mocap_settings_accelerometer_range_from_si(MOCAP_REAL value) {
    return (uint16_t)mocap_nearest_unsigned(value / (MOCAP_REAL)0.1, 100u, 4000u);
}

/* Between steps and rad/s; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_settings_gyroscope_range_to_si(uint16_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)0.017453292519943295;
}

static inline uint16_t mocap_settings_gyroscope_range_from_si(MOCAP_REAL value) {
    return (uint16_t)mocap_nearest_unsigned(value / (MOCAP_REAL)0.017453292519943295, 15u, 4000u);
}

/* Between steps and uT; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_settings_magnetometer_range_to_si(uint16_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)1.0;
}

static inline uint16_t mocap_settings_magnetometer_range_from_si(MOCAP_REAL value) {
    return (uint16_t)mocap_nearest_unsigned(value / (MOCAP_REAL)1.0, 100u, 10000u);
}

/* Between steps and Hz; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_settings_accelerometer_low_pass_to_si(uint16_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)0.1;
}

static inline uint16_t mocap_settings_accelerometer_low_pass_from_si(MOCAP_REAL value) {
    return (uint16_t)mocap_nearest_unsigned(value / (MOCAP_REAL)0.1, 0u, 40000u);
}

/* Between steps and Hz; beyond what the field allows, its nearest end. */
static inline MOCAP_REAL mocap_settings_gyroscope_low_pass_to_si(uint16_t raw) {
    return (MOCAP_REAL)raw * (MOCAP_REAL)0.1;
}

static inline uint16_t mocap_settings_gyroscope_low_pass_from_si(MOCAP_REAL value) {
    return (uint16_t)mocap_nearest_unsigned(value / (MOCAP_REAL)0.1, 0u, 40000u);
}

/* ---- Settings in two slots of flash, of which a loss of power at any instant spares one ----------- */

/* A slot: [magic:4] [generation:4] [length:2] [reserved:2] ([key:1] [size:1] [value:size])* [crc32:4].
 *
 * A commit erases the slot that is not in use, programs everything after the magic, and the magic
 * last: until its last bit is programmed the slot in use is the other one. The flash must let 4 bytes
 * at the beginning of a slot be programmed apart from those after them. */
typedef struct {
    void *context; /* passed to the three functions, which return false on failure */
    bool (*read)(void *context, uint32_t address, uint8_t *data, size_t size);
    bool (*erase)(void *context, uint8_t slot); /* sets every bit of a slot */
    bool (*program)(void *context, uint32_t address, const uint8_t *data, size_t size); /* clears bits */
    uint32_t slot_size; /* slot 0 is at address 0, slot 1 at slot_size */
} mocap_flash;

/* What the two slots say: which is in use, and since which commit. */
typedef struct {
    bool is_found; /* false: neither is good, the settings are those of the factory */
    uint8_t slot;
    uint32_t generation;
    uint16_t length;
} mocap_slot;

#define MOCAP_FLASH_PIECE_SIZE 32u

/* Whether a slot is good. `slot` says which one to look at; the rest of it is filled in. */
static inline bool mocap_slot_check(const mocap_flash *flash, mocap_slot *slot) {
    const uint32_t start = slot->slot * flash->slot_size;
    uint8_t piece[MOCAP_FLASH_PIECE_SIZE];
    uint32_t crc = 0u;
    size_t at = 0u, end;
    slot->is_found = false;
    if (!flash->read(flash->context, start, piece, MOCAP_SLOT_HEAD_SIZE) ||
            mocap_get_u32(piece) != MOCAP_SLOT_MAGIC) {
        return false;
    }
    slot->generation = mocap_get_u32(piece + 4);
    slot->length = mocap_get_u16(piece + 8);
    end = MOCAP_SLOT_HEAD_SIZE + slot->length;
    if (end + 4u > flash->slot_size) {
        return false;
    }
    while (at < end) {
        const size_t size = end - at < sizeof piece ? end - at : sizeof piece;
        if (!flash->read(flash->context, start + (uint32_t)at, piece, size)) {
            return false;
        }
        crc = mocap_crc32(crc, piece, size);
        at += size;
    }
    slot->is_found = flash->read(flash->context, start + (uint32_t)end, piece, 4u) &&
            mocap_get_u32(piece) == crc;
    return slot->is_found;
}

/* Whether a generation comes after another, in serial-number arithmetic (RFC 1982). */
static inline bool mocap_is_newer(uint32_t generation, uint32_t other) {
    const uint32_t ahead = generation - other;
    return ahead != 0u && ahead < 0x80000000u;
}

/* The slot in use: the newest good one. */
static inline mocap_slot mocap_slot_in_use(const mocap_flash *flash) {
    mocap_slot first = {false, 0u, 0u, 0u};
    mocap_slot second = {false, 1u, 0u, 0u};
    (void)mocap_slot_check(flash, &first);
    (void)mocap_slot_check(flash, &second);
    if (second.is_found && (!first.is_found || mocap_is_newer(second.generation, first.generation))) {
        return second;
    }
    return first;
}

/* Fills in the settings: as committed last, else those of the factory. A committed value that this
 * header does not know or allow gives way to the factory's. */
static inline mocap_slot mocap_settings_load(const mocap_flash *flash, mocap_settings *settings) {
    const mocap_slot slot = mocap_slot_in_use(flash);
    uint32_t at = slot.slot * flash->slot_size + MOCAP_SLOT_HEAD_SIZE;
    const uint32_t end = at + slot.length;
    uint8_t value[MOCAP_MAX_SETTING_SIZE];
    mocap_settings_set_factory(settings);
    while (slot.is_found && at + MOCAP_SLOT_ENTRY_SIZE <= end) {
        uint8_t head[MOCAP_SLOT_ENTRY_SIZE];
        if (!flash->read(flash->context, at, head, sizeof head)) {
            break;
        }
        at += MOCAP_SLOT_ENTRY_SIZE;
        if (head[1] <= sizeof value && head[1] <= end - at &&
            flash->read(flash->context, at, value, head[1])) {
            (void)mocap_settings_write(settings, head[0], value, head[1]);
        }
        at += head[1];
    }
    return slot;
}

/* The image of a slot: magic included, every setting in it. */
static inline size_t mocap_slot_image(const mocap_settings *settings, uint32_t generation,
                                      uint8_t image[MOCAP_SLOT_IMAGE_SIZE]) {
    uint8_t *p = image + MOCAP_SLOT_HEAD_SIZE;
    size_t i;
    for (i = 0; i < MOCAP_SETTINGS; ++i) {
        const uint8_t key = mocap_setting_key(i);
        const size_t size = mocap_settings_read(settings, key, p + MOCAP_SLOT_ENTRY_SIZE,
                MOCAP_MAX_SETTING_SIZE);
        p = mocap_put_u8(p, key);
        p = mocap_put_u8(p, (uint8_t)size);
        p += size;
    }
    (void)mocap_put_u32(image, MOCAP_SLOT_MAGIC);
    (void)mocap_put_u32(image + 4, generation);
    (void)mocap_put_u16(image + 8, (uint16_t)((size_t)(p - image) - MOCAP_SLOT_HEAD_SIZE));
    (void)mocap_put_u16(image + 10, 0u);
    p = mocap_put_u32(p, mocap_crc32(0u, image, (size_t)(p - image)));
    return (size_t)(p - image);
}

/* Whether the flash holds these bytes. */
static inline bool mocap_flash_holds(const mocap_flash *flash, uint32_t address, const uint8_t *data,
        size_t size) {
    uint8_t piece[MOCAP_FLASH_PIECE_SIZE];
    size_t at = 0u;
    while (at < size) {
        const size_t step = size - at < sizeof piece ? size - at : sizeof piece;
        if (!flash->read(flash->context, address + (uint32_t)at, piece, step) || memcmp(piece, data + at,
                step) != 0) {
            return false;
        }
        at += step;
    }
    return true;
}

/* Makes these settings the ones in use, all or nothing; `generation` becomes that of the commit.
 * MOCAP_RESULT_BAD_ARGUMENTS for a value outside its limits, MOCAP_RESULT_FLASH_FAILED when the flash
 * did not keep them: those before stay in use. */
static inline mocap_result mocap_settings_commit(const mocap_flash *flash, const mocap_settings *settings,
                                                 uint32_t *generation) {
    const mocap_slot current = mocap_slot_in_use(flash);
    const uint8_t slot = current.is_found ? (uint8_t)(1u - current.slot) : 0u;
    const uint32_t start = slot * flash->slot_size;
    uint8_t image[MOCAP_SLOT_IMAGE_SIZE];
    size_t size;
    if (!mocap_settings_is_valid(settings)) {
        return MOCAP_RESULT_BAD_ARGUMENTS;
    }
    *generation = current.is_found ? current.generation + 1u : 1u;
    size = mocap_slot_image(settings, *generation, image);
    if (size > flash->slot_size || !flash->erase(flash->context, slot) ||
        !flash->program(flash->context, start + MOCAP_SLOT_MAGIC_SIZE, image + MOCAP_SLOT_MAGIC_SIZE,
                        size - MOCAP_SLOT_MAGIC_SIZE) ||
        !mocap_flash_holds(flash, start + MOCAP_SLOT_MAGIC_SIZE, image + MOCAP_SLOT_MAGIC_SIZE,
                           size - MOCAP_SLOT_MAGIC_SIZE) ||
        !flash->program(flash->context, start, image, MOCAP_SLOT_MAGIC_SIZE) ||
        !mocap_flash_holds(flash, start, image, size)) {
        return MOCAP_RESULT_FLASH_FAILED;
    }
    return MOCAP_RESULT_DONE;
}

#ifdef __cplusplus
}
#endif

#endif /* MOCAP_PROTOCOL_H */
