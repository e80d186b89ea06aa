#ifndef FREERTOS_TASK_H
#define FREERTOS_TASK_H

#include "freertos/FreeRTOS.h"

typedef struct task *TaskHandle_t;
typedef void (*TaskFunction_t)(void *);

#ifdef __cplusplus
extern "C" {
#endif

/* The size of the stack is in bytes here, as is what is left of it. */
TaskHandle_t xTaskCreateStaticPinnedToCore(TaskFunction_t code, const char *name, uint32_t stack_size, void *parameters,
                                           UBaseType_t priority, StackType_t *stack, StaticTask_t *state, BaseType_t core);
void vTaskDelete(TaskHandle_t task);
TaskHandle_t xTaskGetCurrentTaskHandle(void);
UBaseType_t uxTaskGetStackHighWaterMark(TaskHandle_t task);

BaseType_t xTaskNotifyGive(TaskHandle_t task);
void vTaskNotifyGiveFromISR(TaskHandle_t task, BaseType_t *is_higher_priority_task_woken);
uint32_t ulTaskNotifyTake(BaseType_t is_to_clear, TickType_t ticks_to_wait);

#ifdef __cplusplus
}
#endif

#endif
