#include "commands.h"

#include "board.h"
#include "card.h"
#include "module.h"
#include "reports.h"
#include "store.h"
#include "wire.h"

#define MOST_PAYLOAD MOCAP_CARD_READ_PAYLOAD_MAX_SIZE /* the longest; a list is cut off where it does not fit */

static mocap_answer_memory memory;
static uint8_t waiting; /* one bit for each answer of the memory: it is to be sent */
static uint32_t due[MOCAP_ANSWER_MEMORY];

/* ---- What each verb does. An action fills in the payload and says how it ended. ---- */

typedef struct {
    const uint8_t *arguments;
    size_t arguments_size;
    uint8_t *payload;
    size_t payload_capacity;
    size_t payload_size;
} request;

static mocap_result hello(request *asked) {
    mocap_hello_arguments host;
    mocap_hello_payload answer;
    if (mocap_decode_hello_arguments(asked->arguments, asked->arguments_size, &host) != MOCAP_GOOD) {
        return MOCAP_RESULT_BAD_ARGUMENTS;
    }
    answer.chosen = mocap_negotiate(host.min_version, host.max_version);
    answer.min_version = MOCAP_LOWEST_VERSION;
    answer.max_version = MOCAP_HIGHEST_VERSION;
    asked->payload_size = mocap_encode_hello_payload(&answer, asked->payload, asked->payload_capacity);
    return MOCAP_RESULT_DONE;
}

static mocap_result identify(request *asked) {
    mocap_identify_arguments arguments;
    if (mocap_decode_identify_arguments(asked->arguments, asked->arguments_size, &arguments) != MOCAP_GOOD) {
        return MOCAP_RESULT_BAD_ARGUMENTS;
    }
    module_blink(arguments.seconds);
    return MOCAP_RESULT_DONE;
}

static mocap_result get_info(request *asked) { /* DeviceInfo and Health follow the answer */
    return asked->arguments_size == 0u ? MOCAP_RESULT_DONE : MOCAP_RESULT_BAD_ARGUMENTS;
}

static mocap_result start(request *asked) {
    if (asked->arguments_size != 0u) {
        return MOCAP_RESULT_BAD_ARGUMENTS;
    }
    module_start_sampling();
    return MOCAP_RESULT_DONE;
}

static mocap_result stop(request *asked) {
    if (asked->arguments_size != 0u) {
        return MOCAP_RESULT_BAD_ARGUMENTS;
    }
    module_stop_sampling();
    return MOCAP_RESULT_DONE;
}

/* The answer to both reading and writing: the key, and the value as it stands now. */
static mocap_result answer_setting(request *asked, uint8_t key) {
    asked->payload[0] = key;
    asked->payload_size = 1u + store_read(key, asked->payload + 1, asked->payload_capacity - 1u);
    return asked->payload_size > 1u ? MOCAP_RESULT_DONE : MOCAP_RESULT_NO_SUCH_SETTING;
}

static mocap_result read_setting(request *asked) {
    mocap_read_setting_arguments arguments;
    if (mocap_decode_read_setting_arguments(asked->arguments, asked->arguments_size, &arguments) != MOCAP_GOOD) {
        return MOCAP_RESULT_BAD_ARGUMENTS;
    }
    return answer_setting(asked, arguments.key);
}

static mocap_result write_setting(request *asked) {
    mocap_write_setting_arguments arguments;
    mocap_result result;
    if (mocap_decode_write_setting_arguments(asked->arguments, asked->arguments_size, &arguments) != MOCAP_GOOD) {
        return MOCAP_RESULT_BAD_ARGUMENTS;
    }
    if (board_are_writes_locked()) {
        return MOCAP_RESULT_REFUSED;
    }
    result = store_stage(arguments.key, arguments.value, arguments.value_size);
    return result == MOCAP_RESULT_DONE ? answer_setting(asked, arguments.key) : result;
}

static mocap_result commit(request *asked) {
    mocap_commit_payload answer;
    mocap_result result;
    if (asked->arguments_size != 0u) {
        return MOCAP_RESULT_BAD_ARGUMENTS;
    }
    if (board_are_writes_locked()) {
        return MOCAP_RESULT_REFUSED;
    }
    result = store_commit(&answer.generation);
    if (result == MOCAP_RESULT_DONE) {
        module_act_by_settings();
        asked->payload_size = mocap_encode_commit_payload(&answer, asked->payload, asked->payload_capacity);
    }
    return result;
}

static mocap_result discard(request *asked) {
    if (asked->arguments_size != 0u) {
        return MOCAP_RESULT_BAD_ARGUMENTS;
    }
    store_discard();
    return MOCAP_RESULT_DONE;
}

static mocap_result factory_reset(request *asked) {
    mocap_factory_reset_arguments arguments;
    uint32_t generation;
    mocap_result result;
    if (mocap_decode_factory_reset_arguments(asked->arguments, asked->arguments_size, &arguments) != MOCAP_GOOD) {
        return MOCAP_RESULT_BAD_ARGUMENTS;
    }
    if (board_are_writes_locked()) {
        return MOCAP_RESULT_REFUSED;
    }
    result = store_factory_reset(&generation);
    if (result == MOCAP_RESULT_DONE) {
        module_act_by_settings();
    }
    return result;
}

static mocap_result list_card(request *asked) {
    mocap_card_list_arguments arguments;
    if (!card_is_there()) {
        return MOCAP_RESULT_NOT_SUPPORTED;
    }
    if (mocap_decode_card_list_arguments(asked->arguments, asked->arguments_size, &arguments) != MOCAP_GOOD) {
        return MOCAP_RESULT_BAD_ARGUMENTS;
    }
    return card_list(arguments.first, asked->payload, asked->payload_capacity, &asked->payload_size);
}

static mocap_result read_card(request *asked) {
    mocap_card_read_arguments arguments;
    if (!card_is_there()) {
        return MOCAP_RESULT_NOT_SUPPORTED;
    }
    if (mocap_decode_card_read_arguments(asked->arguments, asked->arguments_size, &arguments) != MOCAP_GOOD) {
        return MOCAP_RESULT_BAD_ARGUMENTS;
    }
    return card_read(&arguments, asked->payload, asked->payload_capacity, &asked->payload_size);
}

static mocap_result erase_card(request *asked) {
    mocap_card_erase_arguments arguments;
    if (!card_is_there()) {
        return MOCAP_RESULT_NOT_SUPPORTED;
    }
    if (mocap_decode_card_erase_arguments(asked->arguments, asked->arguments_size, &arguments) != MOCAP_GOOD) {
        return MOCAP_RESULT_BAD_ARGUMENTS;
    }
    return board_are_writes_locked() ? MOCAP_RESULT_REFUSED : card_erase(arguments.file);
}

static const struct {
    uint8_t verb;
    mocap_result (*act)(request *);
} actions[] = {
    {MOCAP_VERB_HELLO, hello},
    {MOCAP_VERB_IDENTIFY, identify},
    {MOCAP_VERB_GET_INFO, get_info},
    {MOCAP_VERB_START, start},
    {MOCAP_VERB_STOP, stop},
    {MOCAP_VERB_READ_SETTING, read_setting},
    {MOCAP_VERB_WRITE_SETTING, write_setting},
    {MOCAP_VERB_COMMIT, commit},
    {MOCAP_VERB_DISCARD, discard},
    {MOCAP_VERB_FACTORY_RESET, factory_reset},
    {MOCAP_VERB_CARD_LIST, list_card},
    {MOCAP_VERB_CARD_READ, read_card},
    {MOCAP_VERB_CARD_ERASE, erase_card},
};

static mocap_result act(uint8_t verb, request *asked) {
    size_t i;
    for (i = 0u; i < sizeof actions / sizeof *actions; ++i) {
        if (actions[i].verb == verb) {
            return actions[i].act(asked);
        }
    }
    return MOCAP_RESULT_UNKNOWN_VERB;
}

static const mocap_answer *obey(const mocap_command *command, const uint8_t unique_id[MOCAP_UNIQUE_ID_SIZE]) {
    mocap_acknowledgement answer = {0};
    uint8_t payload[MOST_PAYLOAD];
    request asked = {command->arguments, command->arguments_size, payload, sizeof payload, 0u};
    answer.transaction = command->transaction;
    answer.verb = command->verb;
    memcpy(answer.unique_id, unique_id, sizeof answer.unique_id);
    answer.result = (uint8_t)act(command->verb, &asked);
    answer.payload = payload;
    answer.payload_size = answer.result == MOCAP_RESULT_DONE ? asked.payload_size : 0u;
    return mocap_remember_answer(&memory, &answer);
}

void commands_take(const mocap_wire_frame *frame) {
    uint8_t unique_id[MOCAP_UNIQUE_ID_SIZE];
    mocap_command command;
    const mocap_answer *answer;
    board_unique_id(unique_id);
    if (mocap_decode_command(frame->body, frame->body_size, &command) != MOCAP_GOOD ||
        !mocap_command_is_for(&command, frame->module, wire_module(), unique_id)) {
        return;
    }
    answer = mocap_find_answer(&memory, command.transaction, command.verb);
    if (answer == NULL) { /* a command that comes again is answered, and not obeyed again */
        answer = obey(&command, unique_id);
    }
    if (answer != NULL) {
        const size_t place = (size_t)(answer - memory.answers);
        due[place] = board_time_us() + mocap_answer_delay_us(&command, frame->module, wire_module());
        waiting = (uint8_t)(waiting | 1u << place);
    }
}

/* False where the line is full: it is tried again. */
static bool send(const mocap_answer *answer) {
    mocap_acknowledgement sent;
    if (!wire_report(MOCAP_KIND_ACKNOWLEDGEMENT, board_time_us(), answer->body, answer->size)) {
        return false;
    }
    (void)mocap_decode_acknowledgement(answer->body, answer->size, &sent);
    if (sent.result == MOCAP_RESULT_DONE && sent.verb == MOCAP_VERB_GET_INFO) {
        reports_introduce();
    }
    if (sent.result == MOCAP_RESULT_DONE &&
        (sent.verb == MOCAP_VERB_COMMIT || sent.verb == MOCAP_VERB_FACTORY_RESET)) {
        reports_event(MOCAP_EVENT_SETTINGS_COMMITTED, 0u);
    }
    return true;
}

uint32_t commands_work(void) {
    const uint32_t now = board_time_us();
    uint32_t soonest = UINT32_MAX;
    size_t place;
    for (place = 0u; waiting != 0u && place < MOCAP_ANSWER_MEMORY; ++place) {
        if ((waiting >> place & 1u) == 0u) {
            continue;
        }
        if ((int32_t)(now - due[place]) >= 0 && send(&memory.answers[place])) {
            waiting = (uint8_t)(waiting & ~(1u << place));
        } else if ((int32_t)(due[place] - now) > 0 && due[place] - now < soonest) {
            soonest = due[place] - now;
        } else {
            soonest = soonest < 1000u ? soonest : 1000u; /* the line was full */
        }
    }
    return soonest;
}
