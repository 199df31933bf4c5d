/* Start-up and the two interrupt handlers: what a board support package has to provide, on any processor. */
#include "board.h"

extern uint32_t data_begin, data_end, data_image, bss_begin, bss_end;

__attribute__((noinline)) void idle(void);

ddh_controller controller;

/* Called once there is a stack. */
void start_up(void)
{
    const uint32_t *image = &data_image;
    for (uint32_t *word = &data_begin; word < &data_end; word++) {
        *word = *image++;
    }
    for (uint32_t *word = &bss_begin; word < &bss_end; word++) {
        *word = 0;
    }
    ddh_start(&controller);
    idle();
}

/* Everything happens in the handlers. */
void idle(void)
{
    for (;;) {
        __asm__ volatile("wfi");
    }
}

/* Each millisecond. */
void timer_handler(void)
{
    ddh_frame frames[DDH_MAX_FRAMES];
    uint32_t count = (uint32_t)ddh_period(&controller, frames);
    for (uint32_t n = 0; n < count; n++) {
        CAN->sent[n].id = frames[n].can_id;
        CAN->sent[n].length = frames[n].length;
        CAN->sent[n].low = (uint32_t)frames[n].data;
        CAN->sent[n].high = (uint32_t)(frames[n].data >> 32);
    }
    CAN->to_send = count;
}

/* At each frame that passes the acceptance filter; of the same priority as the timer. */
void can_receive_handler(void)
{
    uint64_t data = (uint64_t)CAN->received.high << 32 | CAN->received.low;
    ddh_receive(&controller, CAN->received.id, (uint8_t)CAN->received.length, data);
}
