/* What carries the wire frames of the process: pty.c or can.c. What a microcontroller does in interrupts and by DMA is done
 * there while the main loop sleeps, in board_idle(). */
#ifndef MODULE_LINE_H
#define MODULE_LINE_H

/* Opens it. `name`: the link to a pseudo-terminal (NULL: none), or the CAN interface. */
void line_open(const char *name);

/* Says why the program cannot go on, and ends it. */
void fail(const char *what);

#endif
