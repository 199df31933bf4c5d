/* Where a RISC-V begins: at the first instruction in flash, without a stack. The trap vector is left to the board. */
__attribute__((naked, section(".vectors"), used)) void reset_handler(void)
{
    __asm__("la sp, stack_top\n"
            "j start_up\n");
}
