/* The one peripheral of the emulated part: a minimal CAN controller. Bit rate, filters and errors are the bench's. */
#ifndef BOARD_H
#define BOARD_H

#include "ddh_controller.h"

typedef struct can_message {
    uint32_t id; /* bit 31 set for a 29-bit identifier */
    uint32_t length;
    uint32_t low; /* bytes 0 to 3, byte 0 the lowest */
    uint32_t high;
} can_message;

typedef struct can_registers {
    can_message received;
    uint32_t to_send; /* how many of `sent` the last period left */
    can_message sent[DDH_MAX_FRAMES];
} can_registers;

#define CAN ((volatile can_registers *)0x40006400u)

void start_up(void);
void timer_handler(void);
void can_receive_handler(void);

#endif
