/* Runs images of compiled models: what tests/agreement holds 64-bit Arm against, under emulation.
   In: a file of cases. Out: a file of what the functions returned and left in their blocks.
     cases      u64 count, then each: u64 bytes of the image, image, u64 slots, u64 runs, then each:
                u64 calls, (u64 function, u64 count)..., slots doubles
     results    for each run of each case: its statuses as one u64, slots doubles */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>

enum { STEP = 7 }; /* the function */
enum { COUNT = 2 }; /* the slot */

typedef uint64_t (*entry)(double *block, const double *pool, uint64_t count);

static void fail(const char *what)
{
    fprintf(stderr, "%s\n", what);
    exit(1);
}

static uint64_t number(FILE *file)
{
    uint64_t n;
    if (fread(&n, sizeof n, 1, file) != 1) fail("the cases end too early");
    return n;
}

static uint64_t field(const unsigned char *image, size_t at)
{
    uint64_t n;
    memcpy(&n, image + at, sizeof n);
    return n;
}

int main(int argc, char **argv)
{
    FILE *in = argc == 3 ? fopen(argv[1], "rb") : NULL, *out = argc == 3 ? fopen(argv[2], "wb") : NULL;
    if (!in || !out) fail("usage: harness CASES RESULTS");
    for (uint64_t cases = number(in); cases; cases--) {
        uint64_t bytes = number(in);
        unsigned char *image = aligned_alloc(64, (bytes + 63) / 64 * 64);
        if (!image || fread(image, 1, bytes, in) != bytes) fail("an image ends too early");
        const double *pool = (const double *)(image + field(image, 72));
        uint64_t code_at = field(image, 88), code_len = field(image, 96);
        unsigned char *code = mmap(NULL, code_len, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
        if (code == MAP_FAILED) fail("no memory for the code");
        memcpy(code, image + code_at, code_len);
        if (mprotect(code, code_len, PROT_READ | PROT_EXEC)) fail("the code cannot be made executable");
        __builtin___clear_cache((char *)code, (char *)code + code_len);
        uint64_t slots = number(in), runs = number(in);
        double *block = calloc(slots, sizeof *block);
        if (!block) fail("no memory for a block");
        for (; runs; runs--) {
            uint64_t calls = number(in), which[32], counts[32];
            if (calls > 32) fail("too many calls");
            for (uint64_t k = 0; k < calls; k++) {
                which[k] = number(in);
                counts[k] = number(in);
            }
            if (fread(block, sizeof *block, slots, in) != slots) fail("a block ends too early");
            uint64_t status = 0;
            for (uint64_t k = 0; k < calls; k++) {
                uint64_t offset = field(image, 104 + 8 * which[k]);
                if (offset == UINT64_MAX) fail("a function is not there");
                entry call;
                unsigned char *address = code + offset;
                memcpy(&call, &address, sizeof call);
                /* Of a single step the count is kept by whoever calls. */
                double before = block[COUNT];
                status = 31 * status + call(block, pool, counts[k]);
                if (which[k] == STEP && counts[k] == 1) block[COUNT] = before + 1;
            }
            fwrite(&status, sizeof status, 1, out);
            fwrite(block, sizeof *block, slots, out);
        }
        free(block);
        munmap(code, code_len);
        free(image);
    }
    return fclose(out) ? 1 : 0;
}
