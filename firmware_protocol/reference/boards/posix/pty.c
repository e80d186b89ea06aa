/* The line as a pseudo-terminal: a gateway opens its other side as it would a serial port. */
#define _XOPEN_SOURCE 700
#define _DEFAULT_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/select.h>
#include <termios.h>
#include <unistd.h>

#include "board.h"
#include "inbox.h"
#include "line.h"
#include "outbox.h"

#define NOBODY_LOOKS_AGAIN_US 5000u

static int line = -1;
static const uint8_t *to_send;
static size_t left_to_send;
static bool has_reader; /* of the other side */
static const char *link_of_line;
static char name_of_line[64];

/* Nobody has the other side open: what is sent is lost, as on a cable that is plugged in nowhere. */
static void send_on(void) {
    while (left_to_send > 0u) {
        const ssize_t sent = has_reader ? write(line, to_send, left_to_send) : (ssize_t)left_to_send;
        if (sent < 0) {
            return;
        }
        to_send += sent;
        left_to_send -= (size_t)sent;
        if (left_to_send == 0u) {
            outbox_on_sent(); /* which may give the next stretch */
        }
    }
}

void board_uart_send(const uint8_t *data, size_t size) {
    to_send = data;
    left_to_send = size;
}

uint32_t board_uart_time_us(size_t size) {
    (void)size; /* a pseudo-terminal takes no time */
    return 0u;
}

/* What a reader left unread is gone once it has closed its side. */
static void forget_unread(void) {
    const int other = open(ptsname(line), O_RDWR | O_NOCTTY | O_CLOEXEC);
    if (other >= 0) {
        (void)tcflush(other, TCIFLUSH);
        (void)close(other);
    }
}

static void receive(void) {
    uint8_t bytes[256];
    const bool had_reader = has_reader;
    const ssize_t size = read(line, bytes, sizeof bytes);
    ssize_t i;
    has_reader = size >= 0 || errno == EAGAIN || errno == EINTR;
    if (had_reader && !has_reader) {
        forget_unread();
    }
    for (i = 0; i < size; ++i) {
        inbox_on_byte(bytes[i]);
    }
}

void board_idle(uint32_t most_us) {
    sigset_t none;
    fd_set readable, writable;
    struct timespec most = {0, (long)most_us * 1000};
    (void)sigemptyset(&none);
    FD_ZERO(&readable);
    FD_ZERO(&writable);
    send_on();
    if (has_reader) {
        FD_SET(line, &readable);
        if (left_to_send > 0u) {
            FD_SET(line, &writable);
        }
    } else if (most_us > NOBODY_LOOKS_AGAIN_US) {
        most.tv_nsec = NOBODY_LOOKS_AGAIN_US * 1000; /* a line without a reader is always "readable" */
    }
    (void)pselect(line + 1, &readable, &writable, NULL, &most, &none);
    receive();
    send_on();
}

/* Takes the link away, unless another process has laid it anew: the kernel gives the number of a closed
 * pseudo-terminal away again, and whoever followed an old link would write into somebody's terminal. */
static void leave(int number) {
    char now[sizeof name_of_line];
    const ssize_t length = readlink(link_of_line, now, sizeof now - 1u);
    if (length > 0) {
        now[length] = '\0';
        if (strcmp(now, name_of_line) == 0) {
            (void)unlink(link_of_line);
        }
    }
    (void)signal(number, SIG_DFL);
    (void)raise(number);
}

static void show_as(const char *link) {
    static const int ends[] = {SIGTERM, SIGINT, SIGHUP};
    size_t i;
    (void)unlink(link);
    if (symlink(ptsname(line), link) != 0) {
        fail(link);
    }
    (void)snprintf(name_of_line, sizeof name_of_line, "%s", ptsname(line));
    link_of_line = link;
    for (i = 0; i < sizeof ends / sizeof ends[0]; i++) {
        if (signal(ends[i], leave) == SIG_IGN) { /* as nohup has it */
            (void)signal(ends[i], SIG_IGN);
        }
    }
}

void line_open(const char *link) {
    struct termios settings;
    int other;
    line = posix_openpt(O_RDWR | O_NOCTTY);
    if (line < 0 || grantpt(line) != 0 || unlockpt(line) != 0 || fcntl(line, F_SETFD, FD_CLOEXEC) != 0 ||
        fcntl(line, F_SETFL, O_NONBLOCK) != 0) {
        fail("pseudo-terminal");
    }
    other = open(ptsname(line), O_RDWR | O_NOCTTY);
    if (other < 0 || tcgetattr(other, &settings) != 0) {
        fail(ptsname(line));
    }
    cfmakeraw(&settings);
    (void)tcsetattr(other, TCSANOW, &settings);
    (void)close(other); /* only so can it be told whether somebody has it open */
    if (link != NULL) {
        show_as(link);
    }
    (void)printf("%s\n", ptsname(line));
    (void)fflush(stdout);
}
