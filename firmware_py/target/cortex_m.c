/* Vector table of a Cortex-M. */
#include "board.h"

extern uint32_t stack_top;

void reset_handler(void);

void reset_handler(void)
{
    start_up();
}

/* Stands still: what a fault leads to. */
static void halt(void)
{
    for (;;) {
    }
}

typedef union vector {
    void (*handler)(void);
    const void *stack;
} vector;

__attribute__((section(".vectors"), used)) static const vector vectors[17] = {
    [0] = {.stack = &stack_top},
    [1] = {.handler = reset_handler},
    [2] = {.handler = halt}, /* NMI */
    [3] = {.handler = halt}, /* HardFault */
    [15] = {.handler = timer_handler}, /* SysTick */
    [16] = {.handler = can_receive_handler}, /* interrupt 0 */
};
