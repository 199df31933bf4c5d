/* Division on a Cortex-M0+, which has none: what the compiler calls for it, without a loop. */
#include <stdint.h>

uint32_t __aeabi_uidiv(uint32_t dividend, uint32_t divisor);

#define STEP(shift) \
    "lsrs r3, r0, #" #shift "\n" \
    "cmp r3, r1\n" \
    "bcc 1f\n" \
    "lsls r3, r1, #" #shift "\n" \
    "subs r0, r0, r3\n" \
    "1: adcs r2, r2\n"

/* Each step leaves a bit of the quotient in the carry flag. */
__attribute__((naked)) uint32_t __aeabi_uidiv(uint32_t dividend, uint32_t divisor)
{
    __asm__(
        ".syntax unified\n"
        "movs r2, #0\n"
        "lsrs r3, r0, #16\n"
        "cmp r3, r1\n"
        "bcc 2f\n"
        STEP(31) STEP(30) STEP(29) STEP(28) STEP(27) STEP(26) STEP(25) STEP(24)
        STEP(23) STEP(22) STEP(21) STEP(20) STEP(19) STEP(18) STEP(17) STEP(16)
        "2:\n"
        STEP(15) STEP(14) STEP(13) STEP(12) STEP(11) STEP(10) STEP(9) STEP(8)
        STEP(7) STEP(6) STEP(5) STEP(4) STEP(3) STEP(2) STEP(1)
        "cmp r0, r1\n"
        "adcs r2, r2\n"
        "mov r0, r2\n"
        "bx lr\n");
}
