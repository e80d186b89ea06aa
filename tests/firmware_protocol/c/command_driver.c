/* Commands to one device, read on standard input: what the header says it is to do, as text.
 *
 * Arguments: the device's module id. Its unique id is 1, 2, ... 12. Input, again and again:
 * [header module:1] [size:1] [body of a Command:size]. For each command one line:
 *   "ignored", "repeated <delay us> <answer>" or "obeyed <delay us> <answer>"
 * The payload of an answer is the number of commands obeyed so far; HELLO is answered as it should be.
 */
#include <stdio.h>
#include <stdlib.h>

#include "mocap_protocol.h"

static const mocap_answer *obey(mocap_answer_memory *memory, const mocap_command *command,
        const uint8_t *unique_id,
                                uint8_t obeyed) {
    mocap_acknowledgement acknowledgement;
    mocap_hello_arguments versions;
    mocap_hello_payload chosen;
    uint8_t payload[MOCAP_HELLO_PAYLOAD_MAX_SIZE];
    memset(&acknowledgement, 0, sizeof acknowledgement);
    acknowledgement.transaction = command->transaction;
    acknowledgement.verb = command->verb;
    acknowledgement.result = MOCAP_RESULT_DONE;
    memcpy(acknowledgement.unique_id, unique_id, MOCAP_UNIQUE_ID_SIZE);
    acknowledgement.payload = payload;
    acknowledgement.payload_size = 1u;
    payload[0] = obeyed;
    if (command->verb == MOCAP_VERB_HELLO) {
        acknowledgement.payload_size = 0u;
        if (mocap_decode_hello_arguments(command->arguments, command->arguments_size,
                &versions) != MOCAP_GOOD) {
            acknowledgement.result = MOCAP_RESULT_BAD_ARGUMENTS;
        } else {
            chosen.chosen = mocap_negotiate(versions.min_version, versions.max_version);
            chosen.min_version = MOCAP_LOWEST_VERSION;
            chosen.max_version = MOCAP_HIGHEST_VERSION;
            acknowledgement.payload_size = mocap_encode_hello_payload(&chosen, payload, sizeof payload);
        }
    }
    return mocap_remember_answer(memory, &acknowledgement);
}

int main(int argc, char **argv) {
    static mocap_answer_memory memory;
    const uint8_t own_module = (uint8_t)atoi(argc > 1 ? argv[1] : "0");
    const uint8_t unique_id[MOCAP_UNIQUE_ID_SIZE] = {1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12};
    uint8_t head[2], body[255], obeyed = 0;
    while (fread(head, 1, 2, stdin) == 2 && fread(body, 1, head[1], stdin) == head[1]) {
        mocap_command command;
        const mocap_answer *answer;
        size_t i;
        if (mocap_decode_command(body, head[1], &command) != MOCAP_GOOD) {
            return 1;
        }
        if (!mocap_command_is_for(&command, head[0], own_module, unique_id)) {
            printf("ignored\n");
            continue;
        }
        answer = mocap_find_answer(&memory, command.transaction, command.verb);
        printf("%s ", answer != NULL ? "repeated" : "obeyed");
        if (answer == NULL) {
            answer = obey(&memory, &command, unique_id, ++obeyed);
        }
        if (answer == NULL) {
            return 2;
        }
        printf("%lu ", (unsigned long)mocap_answer_delay_us(&command, head[0], own_module));
        for (i = 0; i < answer->size; ++i) {
            printf("%02x", answer->body[i]);
        }
        printf("\n");
    }
    return 0;
}
