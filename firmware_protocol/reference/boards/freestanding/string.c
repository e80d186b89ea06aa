/* Compiled with -fno-tree-loop-distribute-patterns: else the compiler would see memset in memset, and call it. */
#include "string.h"

void *memcpy(void *to, const void *from, size_t size) {
    unsigned char *put = to;
    const unsigned char *got = from;
    while (size-- > 0u) {
        *put++ = *got++;
    }
    return to;
}

void *memmove(void *to, const void *from, size_t size) {
    unsigned char *put = to;
    const unsigned char *got = from;
    if (put < got) {
        return memcpy(to, from, size);
    }
    while (size-- > 0u) {
        put[size] = got[size];
    }
    return to;
}

void *memset(void *to, int value, size_t size) {
    unsigned char *put = to;
    while (size-- > 0u) {
        *put++ = (unsigned char)value;
    }
    return to;
}

int memcmp(const void *one, const void *other, size_t size) {
    const unsigned char *a = one, *b = other;
    for (; size > 0u; --size, ++a, ++b) {
        if (*a != *b) {
            return *a < *b ? -1 : 1;
        }
    }
    return 0;
}
