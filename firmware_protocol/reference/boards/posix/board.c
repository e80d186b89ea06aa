/* A process of this computer as a module: a file as its memory, a signal as its timer, a line (line.h).
 *
 *     module_posix MEMORY [LINK]          on a pseudo-terminal: its name is printed, and LINK is a symbolic link to it
 *     module_posix_can MEMORY INTERFACE   on a CAN bus of Linux, such as vcan0
 *
 * MEMORY is made where there is none.
 * `led on` and `led off` are printed as the light changes. SIGALRM is the timer interrupt and interrupts the main loop anywhere,
 * as on a microcontroller; SIGVTALRM, after three seconds of computing, is the watchdog, and starts the program anew.
 */
#define _XOPEN_SOURCE 700
#define _DEFAULT_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

#include "image.h"
#include "line.h"
#include "module.h"
#include "samples.h"

#define WATCHDOG_S 3

static uint8_t *memory;
static struct timespec started;
static char **arguments;
static const char *reset_cause = "started";

void fail(const char *what) {
    perror(what);
    exit(1);
}

/* ---- Time ---- */

uint32_t board_time_us(void) {
    struct timespec now;
    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    return image_first_count() + (uint32_t)((int64_t)(now.tv_sec - started.tv_sec) * 1000000 +
                                            (now.tv_nsec - started.tv_nsec) / 1000);
}

void board_wake_at(uint32_t time_us) {
    const int32_t left = (int32_t)(time_us - board_time_us());
    struct itimerval timer = {{0, 0}, {0, 1}};
    if (left > 1) {
        timer.it_value.tv_sec = left / 1000000;
        timer.it_value.tv_usec = left % 1000000;
    }
    (void)setitimer(ITIMER_REAL, &timer, NULL);
}

static void on_alarm(int number) {
    const int before = errno;
    (void)number;
    samples_on_timer();
    errno = before;
}

uint32_t board_interrupts_off(void) {
    sigset_t alarm, before;
    (void)sigemptyset(&alarm);
    (void)sigaddset(&alarm, SIGALRM);
    (void)sigprocmask(SIG_BLOCK, &alarm, &before);
    return (uint32_t)sigismember(&before, SIGALRM);
}

void board_interrupts_on(uint32_t before) {
    sigset_t alarm;
    (void)sigemptyset(&alarm);
    (void)sigaddset(&alarm, SIGALRM);
    if (before == 0u) {
        (void)sigprocmask(SIG_UNBLOCK, &alarm, NULL);
    }
}

/* ---- Memory and all else ---- */

uint8_t *image_bytes(void) {
    return memory;
}

void image_wait_us(uint32_t us) {
    const uint32_t begun = board_time_us();
    while (board_time_us() - begun < us) {
        const struct timespec pause = {0, 1000};
        (void)nanosleep(&pause, NULL);
    }
}

static void write_out(const char *text) {
    ssize_t written = write(STDOUT_FILENO, text, strlen(text));
    (void)written; /* nobody may be looking */
}

void board_led(bool is_on) {
    write_out(is_on ? "led on\n" : "led off\n");
}

static void on_watchdog(int number) {
    const struct itimerval none = {{0, 0}, {0, 0}};
    (void)number;
    (void)board_interrupts_off(); /* timers and masks outlive the start: an alarm before its handler would end the program */
    (void)setitimer(ITIMER_REAL, &none, NULL);
    (void)setenv("MODULE_RESET_CAUSE", "restarted by the watchdog", 1);
    (void)execv("/proc/self/exe", arguments);
}

void board_watchdog_begin(void) {
    board_watchdog_feed();
}

void board_watchdog_feed(void) {
    const struct itimerval timer = {{0, 0}, {WATCHDOG_S, 0}};
    (void)setitimer(ITIMER_VIRTUAL, &timer, NULL);
}

const char *board_reset_cause(void) {
    return reset_cause;
}

size_t board_stack_used(void) {
    return 0u;
}

/* A new file is erased flash; its number is made from its inode. */
static void open_memory(const char *path) {
    const int file = open(path, O_RDWR | O_CREAT | O_CLOEXEC, 0644);
    struct stat status;
    bool is_new;
    if (file < 0 || fstat(file, &status) != 0) {
        fail(path);
    }
    is_new = status.st_size == 0;
    if (is_new && ftruncate(file, IMAGE_SIZE) != 0) {
        fail(path);
    }
    memory = mmap(NULL, IMAGE_SIZE, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    if (memory == MAP_FAILED) {
        fail(path);
    }
    (void)close(file);
    if (is_new) {
        memset(memory, 0xFF, IMAGE_FLASH_SIZE);
        (void)mocap_put_u64(memory + IMAGE_FACTORY_PAGE, (uint64_t)status.st_ino);
        memory[IMAGE_FACTORY_PAGE + MOCAP_UNIQUE_ID_SIZE - 1u] = 0x5Au;
    }
}

static void handle(int number, void (*handler)(int)) {
    struct sigaction action;
    memset(&action, 0, sizeof action);
    action.sa_handler = handler;
    action.sa_flags = SA_RESTART;
    (void)sigemptyset(&action.sa_mask);
    (void)sigaction(number, &action, NULL);
}

int main(int count, char **given) {
    sigset_t every;
    arguments = given;
    if (count < 2) {
        (void)fprintf(stderr, "usage: %s MEMORY [LINK or CAN interface]\n", given[0]);
        return 2;
    }
    if (getenv("MODULE_RESET_CAUSE") != NULL) {
        reset_cause = getenv("MODULE_RESET_CAUSE");
    }
    (void)clock_gettime(CLOCK_MONOTONIC, &started);
    open_memory(given[1]);
    line_open(count > 2 ? given[2] : NULL);
    handle(SIGALRM, on_alarm);
    handle(SIGVTALRM, on_watchdog);
    (void)sigfillset(&every); /* a restart by the watchdog leaves its own signal blocked */
    (void)sigprocmask(SIG_UNBLOCK, &every, NULL);
    module_begin();
    for (;;) {
        module_work();
    }
}
