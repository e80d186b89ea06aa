/* The line as a CAN bus of Linux (SocketCAN). Error frames tell that the controller has left the bus. */
#define _XOPEN_SOURCE 700
#define _DEFAULT_SOURCE
#include <fcntl.h>
#include <signal.h>
#include <linux/can.h>
#include <linux/can/error.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <stdio.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <unistd.h>

#include "board.h"
#include "line.h"
#include "wire_can.h"

static int bus = -1;
static bool is_full; /* the interface takes no more just now */

bool board_can_send(const mocap_can_frame *frame) {
    struct can_frame sent;
    memset(&sent, 0, sizeof sent);
    sent.can_id = frame->identifier | CAN_EFF_FLAG;
    sent.can_dlc = frame->length;
    memcpy(sent.data, frame->data, frame->length);
    is_full = write(bus, &sent, sizeof sent) != (ssize_t)sizeof sent;
    return !is_full;
}

static void receive(void) {
    struct can_frame came;
    while (read(bus, &came, sizeof came) == (ssize_t)sizeof came) {
        mocap_can_frame frame;
        if ((came.can_id & CAN_ERR_FLAG) != 0u) {
            if ((came.can_id & CAN_ERR_BUSOFF) != 0u) {
                can_on_bus_off(); /* the interface comes back by itself: `ip link set can0 type can restart-ms 100` */
            }
            continue;
        }
        memset(&frame, 0, sizeof frame);
        frame.is_extended = (came.can_id & CAN_EFF_FLAG) != 0u;
        frame.is_remote = (came.can_id & CAN_RTR_FLAG) != 0u;
        frame.identifier = came.can_id & CAN_EFF_MASK;
        frame.length = came.can_dlc;
        memcpy(frame.data, came.data, came.can_dlc);
        can_on_frame(&frame);
    }
}

void board_idle(uint32_t most_us) {
    sigset_t none;
    fd_set readable, writable;
    const struct timespec most = {0, (long)most_us * 1000};
    (void)sigemptyset(&none);
    FD_ZERO(&readable);
    FD_ZERO(&writable);
    FD_SET(bus, &readable);
    if (is_full) {
        FD_SET(bus, &writable);
    }
    (void)pselect(bus + 1, &readable, &writable, NULL, &most, &none);
    receive();
    can_on_sent();
}

void line_open(const char *name) {
    const can_err_mask_t errors = CAN_ERR_BUSOFF;
    struct sockaddr_can address;
    struct ifreq interface;
    memset(&address, 0, sizeof address);
    memset(&interface, 0, sizeof interface);
    if (name == NULL || strlen(name) >= sizeof interface.ifr_name) {
        fail("name a CAN interface");
    }
    strcpy(interface.ifr_name, name);
    bus = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    if (bus < 0 || ioctl(bus, SIOCGIFINDEX, &interface) != 0) {
        fail(name);
    }
    address.can_family = AF_CAN;
    address.can_ifindex = interface.ifr_ifindex;
    if (setsockopt(bus, SOL_CAN_RAW, CAN_RAW_ERR_FILTER, &errors, sizeof errors) != 0 ||
        fcntl(bus, F_SETFD, FD_CLOEXEC) != 0 || fcntl(bus, F_SETFL, O_NONBLOCK) != 0 ||
        bind(bus, (struct sockaddr *)&address, sizeof address) != 0) {
        fail(name);
    }
    (void)printf("%s\n", name);
    (void)fflush(stdout);
}
