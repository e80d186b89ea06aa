#include "module.h"
#include "start.h"

int main(void) {
    board_begin();
    module_begin();
    for (;;) {
        module_work();
    }
}
