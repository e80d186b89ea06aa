/* The four functions of the C library that the module and the compiler use, for boards that are linked without one. */
#ifndef MODULE_STRING_H
#define MODULE_STRING_H

#include <stddef.h>

void *memcpy(void *to, const void *from, size_t size);
void *memmove(void *to, const void *from, size_t size);
void *memset(void *to, int value, size_t size);
int memcmp(const void *one, const void *other, size_t size);

#endif
