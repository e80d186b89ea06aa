#include "board_qemu.h"
#include "module.h"

int main(void) {
    board_begin();
    module_begin();
    for (;;) {
        module_work();
    }
}
