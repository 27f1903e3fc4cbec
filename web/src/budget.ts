/** How many splats a device draws at a good pace. */

const ON_PHONES = 1_000_000;
const ELSEWHERE = 3_000_000;

/** For the device at hand. Finer parts of a file that would be more are not fetched. */
export function splatBudget(agent: { userAgent: string } = globalThis.navigator): number {
  const { userAgentData } = agent as { userAgentData?: { mobile?: boolean } };
  const isPhone = userAgentData?.mobile ?? /Android|iPhone|iPad|Mobile/.test(agent.userAgent);
  return isPhone ? ON_PHONES : ELSEWHERE;
}
