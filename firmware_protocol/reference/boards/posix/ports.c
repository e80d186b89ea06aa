/* Modules of a relay on serial ports of this computer, such as the pseudo-terminals of module_posix: named by RELAY_PORTS, with
 * colons between them. One that is not there yet, or has gone, is opened when it is. */
#define _XOPEN_SOURCE 700
#define _DEFAULT_SOURCE
#include "ports.h"

#include <errno.h>
#include <fcntl.h>
#include <stdlib.h>
#include <termios.h>
#include <unistd.h>

#include "board.h"

#define TRY_AGAIN_US 200000u

static const char *names[PORTS_MOST];
static int ports[PORTS_MOST];
static uint32_t tried_us[PORTS_MOST];
static uint8_t count;
static bool is_split;

static void split(void) {
    static char text[1024];
    const char *given = getenv("RELAY_PORTS");
    char *at = text;
    is_split = true;
    if (given == NULL || strlen(given) >= sizeof text) {
        return;
    }
    memcpy(text, given, strlen(given) + 1u);
    while (*at != '\0' && count < PORTS_MOST) {
        names[count] = at;
        ports[count] = -1;
        tried_us[count++] = board_time_us() - TRY_AGAIN_US;
        at += strcspn(at, ":");
        if (*at == ':') {
            *at++ = '\0';
        }
    }
}

uint8_t board_ports(void) {
    if (!is_split) {
        split();
    }
    return count;
}

static void open_port(uint8_t port) {
    struct termios settings;
    if (board_time_us() - tried_us[port] < TRY_AGAIN_US) {
        return;
    }
    tried_us[port] = board_time_us();
    ports[port] = open(names[port], O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    if (ports[port] >= 0 && tcgetattr(ports[port], &settings) == 0) {
        cfmakeraw(&settings);
        (void)tcsetattr(ports[port], TCSANOW, &settings);
    }
}

size_t board_port_read(uint8_t port, uint8_t *data, size_t size) {
    ssize_t got;
    if (ports[port] < 0) {
        open_port(port);
    }
    if (ports[port] < 0) {
        return 0u;
    }
    got = read(ports[port], data, size);
    if (got == 0 || (got < 0 && errno != EAGAIN && errno != EINTR)) {
        (void)close(ports[port]);
        ports[port] = -1;
    }
    return got > 0 ? (size_t)got : 0u;
}

void board_port_write(uint8_t port, const uint8_t *data, size_t size) {
    if (ports[port] >= 0) {
        const ssize_t written = write(ports[port], data, size);
        (void)written;
    }
}
