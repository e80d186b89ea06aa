/* One number that outlives a restart, in a file of this machine. */
#pragma once
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

struct Preferences {
  bool begin(const char *) { return true; }
  uint64_t getULong64(const char *, uint64_t otherwise) {
    unsigned long long value = otherwise;
    if (FILE *file = fopen(getenv("FLASH"), "r")) {
      if (fscanf(file, "%llu", &value) != 1) value = otherwise;
      fclose(file);
    }
    return value;
  }
  size_t putULong64(const char *, uint64_t value) {
    FILE *file = fopen(getenv("FLASH"), "w");
    if (file == NULL) return 0;
    fprintf(file, "%llu", (unsigned long long)value);
    fclose(file);
    return sizeof value;
  }
};
