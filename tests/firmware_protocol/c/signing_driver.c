/* Reads cases on standard input, says in text what the header makes of each. A case is
 * [what:1] [size:4] [key:32] [signer:4] [count:8] [data], size being that of key to data. What:
 *   h  the tag of the data
 *   s  data, one wire frame as sent, with its signature before it
 *   d  bytes of a signed link: the wire frames taken, what was dropped, the newest count
 */
#include <stdio.h>
#include <stdlib.h>

#include "mocap_protocol.h"

static void print_hex(const char *name, const uint8_t *data, size_t size) {
    size_t i;
    printf("%s ", name);
    for (i = 0; i < size; ++i) {
        printf("%02x", data[i]);
    }
    printf("\n");
}

static void print_tag(const uint8_t *key, const uint8_t *data, size_t size) {
    mocap_blake2s hash;
    uint8_t tag[MOCAP_TAG_SIZE];
    mocap_blake2s_begin(&hash, key);
    mocap_blake2s_put(&hash, data, size / 2u); /* in two parts */
    mocap_blake2s_put(&hash, data + size / 2u, size - size / 2u);
    mocap_blake2s_end(&hash, tag);
    print_hex("tag", tag, sizeof tag);
}

static void print_signed(mocap_signing *signing, const uint8_t *data, size_t size) {
    uint8_t signature[MOCAP_SENT_SIGNATURE_SIZE];
    print_hex("signature", signature, mocap_sign(signing, data, size, signature));
}

static void print_taken(mocap_signing *signing, const uint8_t *data, size_t size) {
    static uint8_t buffer[MOCAP_MAX_STUFFED_SIZE], sent[MOCAP_MAX_STUFFED_SIZE + 1u];
    mocap_signed_decoder decoder;
    mocap_wire_frame frame;
    size_t i;
    mocap_signed_decoder_init(&decoder, signing, buffer, sizeof buffer);
    for (i = 0; i < size; ++i) {
        if (mocap_signed_decoder_push(&decoder, data[i], &frame)) {
            print_hex("frame", sent, mocap_encode_frame(&frame, sent, sizeof sent));
        }
    }
    for (i = 1; i < MOCAP_DEFECTS; ++i) {
        if (decoder.frames.dropped[i] > 0u) {
            printf("dropped %u %lu\n", (unsigned)i, (unsigned long)decoder.frames.dropped[i]);
        }
    }
    printf("count %llu\n", (unsigned long long)signing->count);
}

int main(void) {
    uint8_t head[5];
    while (fread(head, 1, sizeof head, stdin) == sizeof head) {
        const size_t size = mocap_get_u32(head + 1);
        uint8_t *data = (uint8_t *)malloc(size); /* exactly as long as said, for the sanitizer */
        mocap_signing signing;
        if (data == NULL || size < 44u || fread(data, 1, size, stdin) != size) {
            return 1;
        }
        mocap_signing_begin(&signing, data, mocap_get_u32(data + 32), mocap_get_u64(data + 36));
        switch (head[0]) {
            case 'h': print_tag(data, data + 44, size - 44u); break;
            case 's': print_signed(&signing, data + 44, size - 44u); break;
            case 'd': print_taken(&signing, data + 44, size - 44u); break;
            default: return 2;
        }
        printf("end\n");
        free(data);
    }
    return 0;
}
